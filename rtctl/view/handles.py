"""What can be dragged in a scene."""

from collections.abc import Callable

import numpy as np
import viser

from rtctl.types import F64


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
