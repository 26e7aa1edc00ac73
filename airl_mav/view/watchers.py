"""Those who watch, and their cameras, which fly along with the vehicle."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

CHASE = np.array([-5.0, 0.0, -3.2])
"""Where a watcher's camera begins, from the vehicle, NED [m]."""

SLIM = 1.5
"""A page so much higher than wide is a phone's, where the panel covers the lower half."""

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
        self._placed: set[int] = set()
        """Those whose camera has been put behind the vehicle."""
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._part)

    @property
    def there(self) -> bool:
        """Whether anybody watches."""
        return bool(self._server.get_clients())

    def follow(self, position: tuple[float, float, float]) -> None:
        """Move the cameras that follow along; the vehicle is at `position` NED [m]."""
        at = np.array(position)
        for number, client in self._server.get_clients().items():
            switch, camera = self._following.get(number), client.camera
            if switch is None or not switch.value:
                continue
            # As each has turned and zoomed it since.
            offset = camera.position - camera.look_at
            if number not in self._placed:
                self._placed.add(number)
                offset = CHASE
            slim = camera.image_height > SLIM * camera.image_width
            aim = at + BELOW if slim else at
            with client.atomic():
                camera.position = aim + offset
                camera.look_at = aim

    def _welcome(self, client: viser.ClientHandle) -> None:
        switch = client.gui.add_checkbox("Follow the vehicle", True, order=-1.0)
        self._following[client.client_id] = switch

    def _part(self, client: viser.ClientHandle) -> None:
        self._following.pop(client.client_id, None)
        self._placed.discard(client.client_id)
        if not self.there:
            self._deserted()
