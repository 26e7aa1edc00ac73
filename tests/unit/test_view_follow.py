"""Follow camera: the vehicle stays visible, and manual rotation is kept."""

from __future__ import annotations

import math
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser
from numpy.typing import NDArray

from airl_mav.addons.view.view_messages import Shown
from airl_mav.addons.view.view_server import CHASE, KEPT, NEAREST_M, Watchers, unhidden
from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape

AT = np.array([0.0, 0.0, -2.5])
BACK = np.array([-6.0, 0.0, 0.0])


def arena(*bodies: tuple[Shape, tuple[float, float, float], tuple[float, float, float]]) -> Arena:
    n = len(bodies)
    return Arena(
        name="sight",
        seed=0,
        bounds=Bounds(-20.0, 20.0, -2.0, 2.0, 5.0),
        wall_colour=(0, 0, 0),
        obstacles=Obstacles(
            np.array([shape for shape, _, _ in bodies], np.int8),
            np.array([center for _, center, _ in bodies], np.float64).reshape(n, 3),
            np.array([half for _, _, half in bodies], np.float64).reshape(n, 3),
            np.zeros(n),
        ),
        tours=(),
        goal=np.array([10.0, 0.0]),
    )


BALL = (Shape.SPHERE, (-3.0, 0.0, -2.5), (0.5, 0.5, 0.5))


@pytest.mark.parametrize("bearing", [0.0, 1.0, 2.5, -2.0])
def test_the_camera_stays_before_a_sphere(bearing: float) -> None:
    turn = np.array([math.cos(bearing), math.sin(bearing), 0.0])
    there = (Shape.SPHERE, tuple(AT + 3.0 * turn), (0.5, 0.5, 0.5))
    placed = unhidden(arena(there), 0, AT, 6.0 * turn)
    np.testing.assert_allclose(placed, KEPT * 2.5 * turn, atol=1e-5)


def test_what_is_beside_behind_or_beyond_hides_nothing() -> None:
    for center in ((-3.0, 0.6, -2.5), (3.0, 0.0, -2.5), (-6.6, 0.0, -2.5)):
        there = arena((Shape.SPHERE, center, (0.5, 0.5, 0.5)))
        np.testing.assert_array_equal(
            unhidden(there, 0, AT, np.array([-6.0, 0.0, 0.0])), [-6, 0, 0]
        )


def test_walls_are_looked_through_and_the_floor_is_not() -> None:
    aside = np.array([0.0, 8.0, -3.0])
    np.testing.assert_array_equal(unhidden(arena(), 0, AT, aside), aside)
    under = unhidden(arena(), 0, AT, np.array([0.0, -3.0, 4.0]))
    np.testing.assert_allclose(under, KEPT * 2.5 / 4.0 * np.array([0.0, -3.0, 4.0]), atol=1e-5)


def test_close_by_is_close_enough() -> None:
    near = arena((Shape.BOX, (-0.8, 0.0, -2.5), (0.3, 2.0, 2.5)))
    placed = unhidden(near, 0, AT, np.array([-5.0, 0.0, -3.0]))
    assert np.linalg.norm(placed) == pytest.approx(NEAREST_M)
    touched = arena((Shape.BOX, (0.0, 0.0, -2.5), (0.3, 2.0, 2.5)))
    assert np.linalg.norm(unhidden(touched, 0, AT, CHASE)) == pytest.approx(NEAREST_M)


class Page:
    """Page that reports its camera one drawing late, as a browser does."""

    def __init__(self) -> None:
        self.client_id = 7
        self.told: list[NDArray[np.float64]] = []
        self.camera: Any = SimpleNamespace(
            position=np.array([3.0, 3.0, 3.0]),
            look_at=np.zeros(3),
            image_height=600,
            image_width=900,
        )
        self.atomic = nullcontext

    @property
    def offset(self) -> NDArray[np.float64]:
        found: NDArray[np.float64] = self.camera.position - self.camera.look_at
        return found


def shown(north_m: float, *bodies: Any) -> Shown:
    place: Any = SimpleNamespace(position=(north_m, 0.0, -2.5), time_us=0)
    told = Shown()
    told.vehicle, told.episode, told.arena = place, SimpleNamespace(started_us=0), arena(*bodies)  # type: ignore[assignment]
    return told


@pytest.fixture
def watched() -> Any:
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    page, watchers = Page(), Watchers(server)
    watchers._server = SimpleNamespace(get_clients=lambda: {7: page})  # type: ignore[assignment]
    watchers._following[7] = SimpleNamespace(value=True)
    yield watchers, page
    server.stop()


def test_the_camera_goes_back_to_its_place_once_nothing_hides_the_vehicle(watched: Any) -> None:
    watchers, page = watched
    watchers.follow(shown(0.0))
    np.testing.assert_allclose(page.offset, CHASE)
    hides = (Shape.BOX, (-2.0, 0.0, -2.5), (0.3, 2.0, 2.5))
    before = page.offset
    watchers.follow(shown(0.0, hides))
    near = page.offset
    assert np.linalg.norm(near) < 2.0 < np.linalg.norm(before)
    # The page reports the previous camera position, then the current position.
    page.camera.position = page.camera.look_at + before
    watchers.follow(shown(0.5, hides))
    page.camera.position = page.camera.look_at + near
    watchers.follow(shown(9.0, hides))
    np.testing.assert_allclose(page.offset, CHASE)


def test_a_page_may_tell_late_of_where_its_camera_was_at_first(watched: Any) -> None:
    watchers, page = watched
    first = page.offset
    watchers.follow(shown(0.0))
    page.camera.position = page.camera.look_at + first
    watchers.follow(shown(0.5))
    np.testing.assert_allclose(page.offset, CHASE)


def test_who_turns_the_camera_finds_it_turned(watched: Any) -> None:
    watchers, page = watched
    watchers.follow(shown(0.0))
    turned = np.array([0.0, -6.0, -2.0])
    page.camera.position = page.camera.look_at + turned
    for north_m in (1.0, 2.0, 3.0):
        watchers.follow(shown(north_m))
        np.testing.assert_allclose(page.offset, turned)
        np.testing.assert_allclose(page.camera.look_at, [north_m, 0.0, -2.5])
