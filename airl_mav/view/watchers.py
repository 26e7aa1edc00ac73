"""Those who watch, and their cameras, which fly along with the vehicle."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena, Bounds
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.frames import quat_from_euler
from airl_mav.view.shown import Shown

AHEAD = Intrinsics(width=1, height=1, focal=1.0, cx=0.0, cy=0.0)
"""A camera of one ray."""

_FAR_M = 1e4
NO_WALLS = Bounds(-_FAR_M, _FAR_M, -_FAR_M, _FAR_M, 1e-3)
"""The scene's walls can be looked through from outside; its floor cannot."""

KEPT = 0.9
"""Share of the way to an obstacle that the camera takes."""

NEAREST_M = 1.0
"""It comes no nearer, for whatever stands there: less than that shows nothing."""


def unhidden(
    arena: Arena, time_us: int, at: NDArray[np.float64], offset: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the camera's offset from its target NED [m], shortened to before any obstacle."""
    # Imported here: without numba a view has its page ready sooner than a browser opens it.
    from airl_mav.camera.render import render

    away = float(np.linalg.norm(offset))
    if away <= NEAREST_M:
        return offset
    north, east, down = offset.tolist()
    look = quat_from_euler(0.0, math.atan2(-down, math.hypot(north, east)), math.atan2(east, north))
    # Boxes stand in for meshes: nobody looks at the picture, and their file may not be here.
    scene = replace(arena, bounds=NO_WALLS, meshes=())
    depth = render(scene, arena.centers_at(time_us), AHEAD, away, at, look).item()
    if depth == 0.0:
        return offset
    return offset * max(KEPT * depth, NEAREST_M) / away


Floats = NDArray[np.float64]

CHASE = np.array([-5.0, 0.0, -3.2])
"""Where a watcher's camera begins, from the vehicle, NED [m]."""

SLIM = 1.5
"""A page so much higher than wide is a phone's, where the panel covers the lower half."""

UNMOVED_M = 0.02
"""A page tells where its camera is with rounding: nobody has moved it by less."""

REMEMBERED = 60
"""Places that a page may still tell of: those of two seconds."""

BELOW = np.array([0.0, 0.0, 2.2])
"""There the camera looks so far below the vehicle, NED [m]."""


class Watchers:
    """Those of one server."""

    def __init__(
        self, server: viser.ViserServer, deserted: Callable[[], None] = lambda: None
    ) -> None:
        """Welcome who comes; `deserted` is called when the last one has left."""
        self._server = server
        self._deserted = deserted
        self._following: dict[int, Any] = {}
        """The switch of each."""
        self._asked: dict[int, Floats] = {}
        """Where each wants the camera, from the vehicle NED [m]."""
        self._put: dict[int, deque[Floats]] = {}
        """Where it was put lately; a page may tell of it a little later."""
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._part)

    @property
    def there(self) -> bool:
        """Whether anybody watches."""
        return bool(self._server.get_clients())

    def expect(self, shown: Shown) -> None:
        """Let pages that open from now on begin with the vehicle in sight, not somewhere else."""
        if shown.vehicle is None:
            return
        at = np.array(shown.vehicle.position)
        begin = self._server.initial_camera
        begin.position, begin.look_at = at + _in_sight(shown, CHASE), at

    def follow(self, shown: Shown) -> None:
        """Move the cameras that follow along with the vehicle, in front of what would hide it."""
        if shown.vehicle is None:
            return
        at = np.array(shown.vehicle.position)
        for number, client in self._server.get_clients().items():
            switch, camera = self._following.get(number), client.camera
            if switch is None or not switch.value:
                continue
            slim = camera.image_height > SLIM * camera.image_width
            aim = at + BELOW if slim else at
            asked = self._asked_by(number, camera.position - camera.look_at)
            offset = _in_sight(shown, asked)
            self._put[number].append(offset)
            with client.atomic():
                camera.position = aim + offset
                camera.look_at = aim

    def _asked_by(self, number: int, found: Floats) -> Floats:
        """Return where a watcher wants the camera, which was `found` there, from the vehicle."""
        if number not in self._asked:
            # The page may tell once more of where its camera was before it is put anywhere.
            self._asked[number], self._put[number] = CHASE, deque([found], maxlen=REMEMBERED)
        elif not any(np.allclose(found, put, atol=UNMOVED_M) for put in self._put[number]):
            self._asked[number] = found  # The watcher has turned or zoomed it.
        return self._asked[number]

    def _welcome(self, client: viser.ClientHandle) -> None:
        switch = client.gui.add_checkbox("Follow the vehicle", True, order=-1.0)
        self._following[client.client_id] = switch

    def _part(self, client: viser.ClientHandle) -> None:
        self._following.pop(client.client_id, None)
        self._asked.pop(client.client_id, None)
        self._put.pop(client.client_id, None)
        if not self.there:
            self._deserted()


def _in_sight(shown: Shown, asked: Floats) -> Floats:
    """Return where a camera is put that was asked for somewhere, from the vehicle NED [m]."""
    vehicle, episode, arena = shown.vehicle, shown.episode, shown.arena
    if vehicle is None or episode is None or arena is None:
        return asked
    at = np.array(vehicle.position)
    return unhidden(arena, vehicle.time_us - episode.started_us, at, asked)
