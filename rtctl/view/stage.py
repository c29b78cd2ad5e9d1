"""The 3D part of a page: robot, obstacles, forces, goal, ways."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import viser
from viser import SceneNodeHandle

from rtctl.log.record.draw import quaternion, rotation
from rtctl.log.record.surroundings import Thing
from rtctl.plain import Json
from rtctl.types import F64
from rtctl.view.body import Body, Pose, split
from rtctl.view.follow import CELL, Story
from rtctl.view.moment import Moment, Reader
from rtctl.view.shapes import ball, triangles

SHOWN = ("type", "dims", "mesh", "cloud", "influence")  # of an obstacle: another is drawn anew
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
FLOOR = 2.0, 200.0  # [m] half of an arm's, a base's
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
DIGITS = 5  # of a pose that is seen: 10 um
SLOW = 6  # frames from one drawing of ways and map to the next
FROM = np.array([0.66, -0.61, 0.44]) / np.linalg.norm([0.66, -0.61, 0.44])  # whence a camera looks at first
ABOVE = np.array([-0.35, -0.45, 0.82]) / np.linalg.norm([-0.35, -0.45, 0.82])  # the same for a base
SIZE = 0.66  # of an arm's reach: radius of what a camera takes in
BASE_SIZE = 5.0  # [m] the same for a base
FOV = math.radians(45.0)  # from top to bottom
NARROW, WIDE = 0.75, 1.6  # aspects: below the first one the panel is under the scene; of a common window
BESIDE, BELOW = 0.22, 0.5  # shares of width and height that the panel has


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
        self._server, self.scene, self.reader, self.body = server, server.scene, reader, body
        self.shown = Shown()
        self._things: dict[str, _Thing] = {}
        self._joints: list[tuple[viser.FrameHandle, int]] = []  # frames, of all joints
        self._parts: list[SceneNodeHandle] = []
        self._spheres: list[SceneNodeHandle] = []
        self._arrows: SceneNodeHandle | None = None
        self._poses: dict[str, Pose] = {}  # where nodes were put, by name
        self._frame = 0
        self._place: F64 = np.zeros(3)  # [m] of the moment that is drawn
        self._goal_now: F64 | None = None
        self.scale = 25.0 if reader.is_base else 1.0
        self._furnish(server)

    def _furnish(self, server: viser.ViserServer) -> None:
        scene, big = self.scene, self.scale
        scene.set_up_direction("+z")
        scene.add_grid(
            "/floor",
            2.0 * FLOOR[self.reader.is_base],
            2.0 * FLOOR[self.reader.is_base],
            cell_size=1.0 if self.reader.is_base else 0.1,
            section_size=5.0 if self.reader.is_base else 0.5,
            plane_opacity=0.0,
            cell_color=(226, 228, 232),
            section_color=(198, 202, 210),
            position=(0.0, 0.0, -0.002),
        )
        server.initial_camera.fov = FOV
        server.initial_camera.position, server.initial_camera.look_at = self._camera(WIDE)
        if self.body is not None:
            names = self._hang(self.body)
            for k, piece in enumerate(self.body.pieces):
                position, wxyz = split(piece.X)
                part = scene.add_mesh_simple(
                    f"{names[piece.joint]}/piece{k}",
                    piece.vertices,
                    piece.faces,
                    color=piece.colour,
                    side="double",
                    position=np.array(position),
                    wxyz=np.array(wxyz),
                )
                self._parts.append(part)
            for k, (joint, local, radius) in enumerate(self.body.points):
                look = ball(radius, 2)
                sphere = scene.add_mesh_simple(
                    f"{names[joint]}/sphere{k}",
                    look.vertices,
                    look.faces,
                    color=SPHERE,
                    opacity=0.35,
                    visible=False,
                    cast_shadow=False,
                    position=local,
                )
                self._spheres.append(sphere)
            self.choose(self.shown._replace(spheres=not self.body.pieces))
        else:
            self._base = scene.add_frame("/base", show_axes=False)
            for k, (x, y, radius) in enumerate(p for p in self.reader.points if len(p) == 3):
                scene.add_cylinder(f"/base/{k}", float(radius), 0.2, SPHERE, position=(x, y, 0.1))
            nose = np.array([[[0.0, 0.0, 0.3], [1.2, 0.0, 0.3]]])
            scene.add_arrows("/base/nose", nose, BEHIND, shaft_radius=0.06, head_radius=0.18, head_length=0.4)
        self._tip = scene.add_icosphere("/tip", 0.008 * big, BEHIND, visible=self.body is not None)
        self._goal = scene.add_icosphere("/goal", 0.014 * big, GOAL, opacity=0.9, visible=False)
        self._lines: dict[str, SceneNodeHandle] = {}

    def _hang(self, body: Body) -> list[str]:
        """Add a frame for each joint, in that of the joint that carries it; return their names, the base's first.

        What hangs on one is not told where it is: of a joint that turns the page is told the turn alone.
        """
        names = ["/robot"]
        root = self.scene.add_frame(names[0], show_axes=False)
        self._put(root, *body.pose(0))
        for joint, carrier in body.carried():
            names.append(f"{names[carrier]}/{joint}")
            self._joints.append((self.scene.add_frame(names[-1], show_axes=False), joint))
        return names

    def face(self, client: viser.ClientHandle, all_of_it: bool = True) -> None:
        """Turn a viewer's camera to the robot, so that the panel hides none of it; of a base to its goal, too."""
        client.camera.fov = FOV
        client.camera.position, client.camera.look_at = self._camera(client.camera.aspect, all_of_it)

    def _camera(self, aspect: float, all_of_it: bool = True) -> tuple[F64, F64]:
        """Return position and what is looked at (3,) [m]: the work space fills what the panel leaves of a window.

        aspect: width of the window over its height.
        """
        if self.body is not None:
            whence, reach = FROM, self.body.reach()
            centre, size = self.body.base[:3, 3] + reach * np.array([0.22, 0.0, 0.37]), SIZE * reach
        else:
            whence, goal = ABOVE, self._goal_now if all_of_it and self._goal_now is not None else self._place
            centre, size = 0.5 * (self._place + goal), BASE_SIZE + 0.5 * float(np.linalg.norm(goal - self._place))
        beside, below = (0.0, BELOW) if aspect < NARROW else (BESIDE, 0.0)
        up, across = math.tan(0.5 * FOV), math.tan(0.5 * FOV) * aspect
        away = size / min(up * (1.0 - below), across * (1.0 - beside))
        right = np.cross(-whence, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        aside = away * (beside * across * right - below * up * np.cross(right, -whence))
        return centre + away * whence + aside, centre + aside

    def choose(self, shown: Shown) -> None:
        """Show what a viewer wants to see."""
        self.shown = shown
        for part in self._parts:
            part.visible = shown.meshes
        for sphere in self._spheres:
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
            for frame, joint in self._joints:
                self._put(frame, *self.body.pose(joint))
        elif self.reader.is_base:
            self._put(self._base, m.place.tolist(), (math.cos(0.5 * m.heading), 0.0, 0.0, math.sin(0.5 * m.heading)))
        moved = m.goal is not None and (self._goal_now is None or float(np.linalg.norm(m.goal - self._goal_now)) > 1.0)
        self._place, self._goal_now = m.place, m.goal
        if moved and self.reader.is_base:  # a new goal: the whole trip is shown
            for client in self._server.get_clients().values():
                self.face(client)
        self._put(self._tip, m.place.tolist())
        self._goal.visible = m.goal is not None
        if m.goal is not None:
            self._put(self._goal, m.goal.tolist())
        self._obstacles(story.things, m.time)
        self._forces(m)
        if self._frame % SLOW == 1:
            self._ways(story, m)

    def _put(self, node: SceneNodeHandle, place: Sequence[float], wxyz: Sequence[float] = UPRIGHT) -> None:
        """Put a node somewhere, place (3,) [m], unless nobody would see it move: each time costs a message."""
        at, turned = [round(v, DIGITS) for v in place], [round(v, DIGITS) for v in wxyz]
        before = self._poses.get(node.name, ([], []))
        self._poses[node.name] = at, turned
        if before[0] != at:
            node.position = np.array(place)
        if before[1] != turned:
            node.wxyz = np.array(wxyz)

    def _obstacles(self, things: dict[str, tuple[Thing, bool]], now: float) -> None:
        for name in [name for name in self._things if name not in things]:
            self._things.pop(name).frame.remove()
        for name, (thing, is_fixed) in things.items():
            told = thing.shape
            have = self._things.get(name)
            if have is None or any(have.told.get(key) != told.get(key) for key in SHOWN):
                if have is not None:
                    have.frame.remove()
                have = self._things[name] = self._thing(name, thing, is_fixed)
            elapsed = max(0.0, now - thing.time)
            velocity, omega = np.array(told["velocity"], np.float64), np.array(told["omega"], np.float64)
            place = np.array(told["position"], np.float64) + elapsed * velocity
            self._put(have.frame, place.tolist(), _turned(told["wxyz"], omega * elapsed))

    def _thing(self, name: str, thing: Thing, is_fixed: bool) -> _Thing:
        frame = self.scene.add_frame(f"/obstacles/{name}", show_axes=False)
        self._poses.pop(frame.name, None)  # one of this name may have stood elsewhere
        reach = float(thing.shape.get("influence") or self.reader.influence)
        body, shell = triangles(thing.shape, thing.boxes), triangles(thing.shape, thing.boxes, reach)
        colour = OWN if is_fixed else TOLD
        if body is not None:
            is_plane = thing.shape.get("type") == "plane"
            self.scene.add_mesh_simple(
                f"/obstacles/{name}/body",
                body.vertices,
                body.faces,
                color=colour,
                opacity=0.25 if is_plane else None,
                side="front",
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
                opacity=0.06 if thing.shape.get("type") == "plane" else 0.16,
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
        self._cloud("/map", story.seen.places(), (140, 142, 152), CELL)
        self._cloud("/scan", m.scan, SEEN, 1.2 * CELL)

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
