"""Viewers of a page and their scene cameras, which follow the vehicle."""

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
"""Camera with a single ray."""

_FAR_M = 1e4
NO_WALLS = Bounds(-_FAR_M, _FAR_M, -_FAR_M, _FAR_M, 1e-3)
"""Bounds for ray casting: the scene's walls are transparent from outside, its floor is not."""

KEPT = 0.9
"""Camera distance as a fraction of the distance to an obstacle in between."""

NEAREST_M = 1.0
"""Minimum distance from camera to target [m], even behind an obstacle."""


def unhidden(
    arena: Arena, time_us: int, at: NDArray[np.float64], offset: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the camera's offset from its target NED [m], shortened to avoid obstacles."""
    # Imported here: the page is ready sooner without loading numba.
    from airl_mav.camera.render import render

    away = float(np.linalg.norm(offset))
    if away <= NEAREST_M:
        return offset
    north, east, down = offset.tolist()
    look = quat_from_euler(0.0, math.atan2(-down, math.hypot(north, east)), math.atan2(east, north))
    # Collision boxes replace meshes: the depth suffices, and mesh files may be missing.
    scene = replace(arena, bounds=NO_WALLS, meshes=())
    depth = render(scene, arena.centers_at(time_us), AHEAD, away, at, look).item()
    if depth == 0.0:
        return offset
    return offset * max(KEPT * depth, NEAREST_M) / away


Floats = NDArray[np.float64]

CHASE = np.array([-5.0, 0.0, -3.2])
"""Initial camera offset from the vehicle, NED [m]."""

SLIM = 1.5
"""Minimum height/width ratio of a phone's page, where the panel covers the lower half."""

UNMOVED_M = 0.02
"""Rounding tolerance of reported camera positions [m]; a larger change is the viewer's."""

REMEMBERED = 60
"""Number of recent camera offsets that a page may still report, about two seconds."""

BELOW = np.array([0.0, 0.0, 2.2])
"""Offset of the look-at point from the vehicle on a phone, NED [m]."""


class Watchers:
    """Viewers of one server."""

    def __init__(
        self, server: viser.ViserServer, deserted: Callable[[], None] = lambda: None
    ) -> None:
        """Register for connections; `deserted` is called when the last viewer disconnects."""
        self._server = server
        self._deserted = deserted
        self._following: dict[int, Any] = {}
        """Checkbox "Follow the vehicle" of each client."""
        self._asked: dict[int, Floats] = {}
        """Requested camera offset of each client from the vehicle, NED [m]."""
        self._put: dict[int, deque[Floats]] = {}
        """Recently set camera offsets of each client; pages report them with a delay."""
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._part)

    @property
    def there(self) -> bool:
        """True if at least one client is connected."""
        return bool(self._server.get_clients())

    def expect(self, shown: Shown) -> None:
        """Set the initial camera of new pages so that the vehicle is visible."""
        if shown.vehicle is None:
            return
        at = np.array(shown.vehicle.position)
        begin = self._server.initial_camera
        begin.position, begin.look_at = at + _in_sight(shown, CHASE), at

    def follow(self, shown: Shown) -> None:
        """Move the following cameras with the vehicle, in front of obstacles that hide it."""
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
        """Return a client's requested camera offset; `found` is the offset its page reports."""
        if number not in self._asked:
            # The page may still report the camera pose from before the first update.
            self._asked[number], self._put[number] = CHASE, deque([found], maxlen=REMEMBERED)
        elif not any(np.allclose(found, put, atol=UNMOVED_M) for put in self._put[number]):
            self._asked[number] = found  # The viewer rotated or zoomed the camera.
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
    """Return the unobstructed camera offset for a requested one, from the vehicle NED [m]."""
    vehicle, episode, arena = shown.vehicle, shown.episode, shown.arena
    if vehicle is None or episode is None or arena is None:
        return asked
    at = np.array(vehicle.position)
    return unhidden(arena, vehicle.time_us - episode.started_us, at, asked)
