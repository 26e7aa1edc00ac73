"""Follow camera: manual rotation is kept."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser
from numpy.typing import NDArray

from airl_mav.addons.view.view_messages import Shown
from airl_mav.addons.view.view_server import CHASE, Watchers


class Page:
    """Page of a viewer."""

    def __init__(self) -> None:
        self.client_id = 7
        self.told: list[NDArray[np.float64]] = []
        self.camera: Any = SimpleNamespace(position=CHASE, look_at=np.zeros(3))
        self.atomic = nullcontext

    @property
    def offset(self) -> NDArray[np.float64]:
        found: NDArray[np.float64] = self.camera.position - self.camera.look_at
        return found


def shown(north_m: float) -> Shown:
    told = Shown()
    told.vehicle = SimpleNamespace(position=(north_m, 0.0, -2.5))  # type: ignore[assignment]
    return told


@pytest.fixture
def watched() -> Any:
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    page, watchers = Page(), Watchers(server)
    server.get_clients = lambda: {7: page}  # type: ignore[method-assign,dict-item]
    watchers._following[7] = SimpleNamespace(value=True)
    yield watchers, page
    server.stop()


def test_a_new_page_looks_at_the_vehicle_from_behind(watched: Any) -> None:
    watchers, _ = watched
    watchers.expect(shown(4.0))
    begin = watchers._server.initial_camera
    np.testing.assert_allclose(begin.position - begin.look_at, CHASE)
    np.testing.assert_allclose(begin.look_at, [4.0, 0.0, -2.5])


def test_who_turns_the_camera_finds_it_turned(watched: Any) -> None:
    watchers, page = watched
    watchers.follow(shown(0.0))
    turned = np.array([0.0, -6.0, -2.0])
    page.camera.position = page.camera.look_at + turned
    for north_m in (1.0, 2.0, 3.0):
        watchers.follow(shown(north_m))
        np.testing.assert_allclose(page.offset, turned)
        np.testing.assert_allclose(page.camera.look_at, [north_m, 0.0, -2.5])
