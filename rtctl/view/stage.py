"""The 3D part of a page: robot, obstacles, forces, goal, ways."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import viser
from viser import SceneNodeHandle

from rtctl.log.record.draw import quaternion, rotation
from rtctl.log.record.surroundings import Thing
from rtctl.plain import Json
from rtctl.types import F64
from rtctl.view.body import Body
from rtctl.view.follow import Story
from rtctl.view.moment import Moment, Reader
from rtctl.view.shapes import ball, triangles

TOLD, OWN, SHELL = (70, 120, 225), (150, 155, 165), (225, 140, 40)  # obstacles told, of the config; influence
GOAL, AHEAD, BEHIND, FORCE, SPHERE, SEEN = (
    (40, 165, 80),
    (40, 165, 80),
    (60, 60, 70),
    (215, 45, 45),
    (240, 175, 60),
    (120, 60, 160),
)
NEWTON = 0.004  # [m] length of an arrow for 1 N
LONGEST, SHORTEST = 0.5, 0.03  # [m] of an arrow
MAP_CELL = 0.1  # [m] of what a base has seen
MAP_MOST = 6000  # cells that are drawn
SLOW = 6  # frames from one drawing of trail and map to the next


class Shown(NamedTuple):
    """What a viewer chose to see."""

    meshes: bool = True
    spheres: bool = False
    influence: bool = False
    forces: bool = True
    trail: bool = True


class _Thing(NamedTuple):
    """An obstacle on the stage."""

    told: Json  # by what it was made
    frame: viser.FrameHandle
    shell: SceneNodeHandle | None


class Stage:
    """Draws stories into a scene; what has not changed is not sent again."""

    def __init__(self, server: viser.ViserServer, reader: Reader, body: Body | None) -> None:
        self.scene, self.reader, self.body = server.scene, reader, body
        self.shown = Shown()
        self._things: dict[str, _Thing] = {}
        self._parts: list[tuple[SceneNodeHandle, int, F64]] = []
        self._spheres: list[tuple[SceneNodeHandle, int, F64]] = []
        self._arrows: SceneNodeHandle | None = None
        self._cells: dict[tuple[int, int], None] = {}
        self._frame = 0
        self.scale = 5.0 if reader.is_base else 1.0
        self._furnish(server)

    def _furnish(self, server: viser.ViserServer) -> None:
        scene, big = self.scene, self.scale
        scene.set_up_direction("+z")
        scene.add_grid(
            "/floor",
            4.0 * big,
            4.0 * big,
            cell_size=0.1 * big,
            section_size=0.5 * big,
            plane_opacity=0.0,
            cell_color=(226, 228, 232),
            section_color=(198, 202, 210),
            position=(0.0, 0.0, -0.002),
        )
        base = self.body.base[:3, 3] if self.body is not None else np.zeros(3)
        server.initial_camera.position = base + np.array([1.7, -1.5, 1.25]) * (1.0 if big == 1.0 else 6.0)
        server.initial_camera.look_at = base + np.array([0.25, 0.0, 0.35]) * (1.0 if big == 1.0 else 0.0)
        if self.body is not None:
            for k, piece in enumerate(self.body.pieces):
                part = scene.add_mesh_simple(
                    f"/robot/{k}", piece.vertices, piece.faces, color=piece.colour, side="double"
                )
                self._parts.append((part, piece.joint, piece.X))
            for k, (joint, local, radius) in enumerate(self.body.points):
                X = np.eye(4)
                X[:3, 3] = local
                look = ball(radius, 2)
                sphere = scene.add_mesh_simple(
                    f"/spheres/{k}",
                    look.vertices,
                    look.faces,
                    color=SPHERE,
                    opacity=0.35,
                    visible=False,
                    cast_shadow=False,
                )
                self._spheres.append((sphere, joint, X))
            self.choose(self.shown._replace(spheres=not self.body.pieces))
        else:
            self._base = scene.add_frame("/base", show_axes=False)
            for k, (x, y, radius) in enumerate(p for p in self.reader.points if len(p) == 3):
                scene.add_cylinder(f"/base/{k}", float(radius), 0.2, SPHERE, opacity=0.8, position=(x, y, 0.1))
            nose = np.array([[[0.0, 0.0, 0.25], [0.8, 0.0, 0.25]]])
            scene.add_arrows("/base/nose", nose, FORCE, shaft_radius=0.03, head_radius=0.08, head_length=0.2)
        self._tip = scene.add_icosphere("/tip", 0.008 * big, BEHIND, visible=self.body is not None)
        self._goal = scene.add_icosphere("/goal", 0.018 * big, GOAL, opacity=0.9, visible=False)
        self._lines: dict[str, SceneNodeHandle] = {}

    def choose(self, shown: Shown) -> None:
        """Show what a viewer wants to see."""
        self.shown = shown
        for part, _, _ in self._parts:
            part.visible = shown.meshes
        for sphere, _, _ in self._spheres:
            sphere.visible = shown.spheres
        for thing in self._things.values():
            if thing.shell is not None:
                thing.shell.visible = shown.influence

    def draw(self, story: Story) -> None:
        """Draw the moment of a story."""
        m = story.moment
        if m is None:
            return
        self._frame += 1
        if self.body is not None and len(m.q):
            self.body.move(m.q)
            for part, joint, X in (*self._parts, *(self._spheres if self.shown.spheres else ())):
                part.position, part.wxyz = self.body.pose(joint, X)
        elif self.reader.is_base:
            self._base.position = m.place
            self._base.wxyz = (math.cos(0.5 * m.heading), 0.0, 0.0, math.sin(0.5 * m.heading))
        self._tip.position = m.place
        self._goal.visible = m.goal is not None
        if m.goal is not None:
            self._goal.position = m.goal
        self._obstacles(story.things, m.time)
        self._forces(m)
        if self._frame % SLOW == 1:
            self._ways(story, m)

    def _obstacles(self, things: dict[str, tuple[Thing, bool]], now: float) -> None:
        for name in [name for name in self._things if name not in things]:
            self._things.pop(name).frame.remove()
        for name, (thing, is_fixed) in things.items():
            told = thing.shape
            have = self._things.get(name)
            if have is None or any(have.told.get(key) != told.get(key) for key in ("type", "dims", "mesh", "cloud")):
                if have is not None:
                    have.frame.remove()
                have = self._things[name] = self._thing(name, thing, is_fixed)
            elapsed = max(0.0, now - thing.time)
            velocity, omega = np.array(told["velocity"], np.float64), np.array(told["omega"], np.float64)
            have.frame.position = np.array(told["position"], np.float64) + elapsed * velocity
            have.frame.wxyz = _turned(told["wxyz"], omega * elapsed)

    def _thing(self, name: str, thing: Thing, is_fixed: bool) -> _Thing:
        frame = self.scene.add_frame(f"/obstacles/{name}", show_axes=False)
        body, shell = triangles(thing.shape, thing.boxes), triangles(thing.shape, thing.boxes, self.reader.influence)
        colour = OWN if is_fixed else TOLD
        if body is not None:
            is_plane = thing.shape.get("type") == "plane"
            self.scene.add_mesh_simple(
                f"/obstacles/{name}/body",
                body.vertices,
                body.faces,
                color=colour,
                opacity=0.25 if is_plane else 0.75,
                side="double",
                flat_shading=thing.shape.get("type") in ("box", "plane", "mesh", "cloud"),
                cast_shadow=not is_plane,
            )
        self.scene.add_label(f"/obstacles/{name}/label", name, font_screen_scale=0.85)
        shown = None
        if shell is not None:
            shown = self.scene.add_mesh_simple(
                f"/obstacles/{name}/influence",
                shell.vertices,
                shell.faces,
                color=SHELL,
                opacity=0.16,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
                visible=self.shown.influence,
            )
        return _Thing(thing.shape, frame, shown)

    def _forces(self, m: Moment) -> None:
        """Draw each obstacle's force at the protected point that it is nearest to."""
        arrows = []
        for _, force, index in m.forces if self.shown.forces else ():
            point, size = None if self.body is None else self.body.point(index), float(np.linalg.norm(force))
            start = m.place if point is None else point
            arrows.append([start, start + force / size * min(max(size * NEWTON, SHORTEST), LONGEST)])
        if not arrows:
            if self._arrows is not None:
                self._arrows.visible = False
            return
        points = np.array(arrows, np.float32)
        if isinstance(self._arrows, viser.ArrowsHandle):
            self._arrows.points = points
            self._arrows.visible = True
        else:
            self._arrows = self.scene.add_arrows(
                "/forces", points, FORCE, shaft_radius=0.006, head_radius=0.016, head_length=0.03
            )

    def _ways(self, story: Story, m: Moment) -> None:
        thick = 0.004 * self.scale
        self._line("/ahead", m.way if self.shown.trail else m.way[:0], AHEAD, thick)
        behind = np.array(story.trail) if self.shown.trail and len(story.trail) > 1 else np.zeros((0, 3))
        self._line("/behind", behind, BEHIND, 0.6 * thick)
        if not self.reader.is_base:
            return
        for x, y in np.round(m.scan[:, :2] / MAP_CELL).astype(int).tolist():
            self._cells[(x, y)] = self._cells.pop((x, y), None)  # the newest last
        for old in list(self._cells)[: max(0, len(self._cells) - MAP_MOST)]:
            del self._cells[old]
        self._cloud(
            "/map", np.array([[x * MAP_CELL, y * MAP_CELL, 0.02] for x, y in self._cells]), (150, 150, 160), 0.09
        )
        self._cloud("/scan", m.scan, SEEN, 0.12)

    def forget(self) -> None:
        """Forget what a base has seen: the story begins anew."""
        self._cells.clear()

    def _cloud(self, name: str, points: F64, colour: tuple[int, int, int], size: float) -> None:
        have = self._lines.get(name)
        if not len(points):
            if have is not None:
                have.visible = False
            return
        if isinstance(have, viser.PointCloudHandle) and len(have.points) == len(points):
            have.points, have.visible = points.astype(np.float32), True
        else:
            self._lines[name] = self.scene.add_point_cloud(name, points, colour, point_size=size, precision="float32")

    def _line(self, name: str, corners: F64, colour: tuple[int, int, int], thick: float) -> None:
        have = self._lines.get(name)
        if len(corners) < 2:
            if have is not None:
                have.visible = False
            return
        pieces = np.stack([corners[:-1], corners[1:]], axis=1).astype(np.float32)
        if isinstance(have, viser.LineSegmentsHandle) and len(have.points) == len(pieces):
            have.points, have.visible = pieces, True
        else:
            self._lines[name] = self.scene.add_line_segments(name, pieces, colour, thickness=thick)


class Handles:
    """What can be dragged: the goal and the page's own obstacles."""

    def __init__(self, server: viser.ViserServer, is_base: bool, moved: Callable[[str, F64, bool], None]) -> None:
        """`moved` is told what was moved where (3,) [m], and whether that was the end of it."""
        self._scene, self._is_base, self._moved = server.scene, is_base, moved
        self._have: dict[str, viser.TransformControlsHandle] = {}
        self.grasped = ""  # what is being dragged

    def put(self, name: str, place: F64) -> None:
        """Show a handle, or move it: unless somebody has it in his hand."""
        have = self._have.get(name)
        if have is not None:
            if self.grasped != name:
                have.position = place
            return
        axes = (True, True, not self._is_base)
        handle = self._scene.add_transform_controls(
            f"/handles/{name}",
            0.9 if self._is_base else 0.16,
            active_axes=axes,
            disable_rotations=True,
            depth_test=False,
            position=place,
        )

        @handle.on_update
        def _(event: viser.TransformControlsEvent) -> None:
            self.grasped = "" if event.phase == "end" else name
            self._moved(name, np.array(event.target.position, np.float64), event.phase == "end")

        self._have[name] = handle

    def remove(self, name: str) -> None:
        """Take a handle away."""
        handle = self._have.pop(name, None)
        if handle is not None:
            handle.remove()

    def names(self) -> list[str]:
        """Return what has a handle."""
        return list(self._have)


def _turned(wxyz: list[float], by: F64) -> tuple[float, float, float, float]:
    """Return a quaternion turned by a rotation vector (3,) [rad] in the world."""
    angle = float(np.linalg.norm(by))
    if angle == 0.0:
        w, x, y, z = (float(v) for v in wxyz)
        return w, x, y, z
    x, y, z = (by / angle).tolist()
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn = np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * (K @ K)
    return quaternion(turn @ rotation(wxyz))
