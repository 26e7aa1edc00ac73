"""Safe velocity: its formulas, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from airl_mav.core.errors import FieldError
from airl_mav.envs.spec import Delay
from airl_mav.envs.stopping import (
    Braking,
    DecisionLoop,
    SpeedBound,
    StoppingTask,
    braking_of,
    injections_of,
    open_space,
)
from airl_mav.profiles.vehicle import load_vehicle

QUAD = load_vehicle("quad")
BRAKING = Braking(
    vehicle_sha256="",
    commanded_m_s=(1.0, 2.0, 4.0),
    flown_m_s=(1.0, 2.0, 3.5),
    distance_m=(0.5, 1.5, 5.0),
)
LOOP = DecisionLoop(frame_period_s=0.033, transport_s=0.005, hold_s=0.5, link_s=0.004)


def test_a_stop_is_the_way_of_the_reaction_and_of_the_braking() -> None:
    assert BRAKING.fastest_m_s == 4.0
    for speed, flown, distance in (
        (0.0, 0.0, 0.0),
        (1.0, 1.0, 0.5),
        (2.0, 2.0, 1.5),
        (4.0, 3.5, 5.0),
    ):
        assert BRAKING.stopping_m(speed, 0.0) == pytest.approx(distance)
        assert BRAKING.stopping_m(speed, 2.0) == pytest.approx(2.0 * flown + distance)
    ways = [BRAKING.stopping_m(speed, 0.3) for speed in np.linspace(0.0, 4.0, 41)]
    assert (np.diff(ways) > 0.0).all()


def test_the_safe_velocity_takes_all_the_room() -> None:
    for room in (0.1, 1.0, 3.0, 5.9):
        speed = BRAKING.safe_velocity(0.4, room)
        assert 0.0 < speed < 4.0
        assert BRAKING.stopping_m(speed, 0.4) == pytest.approx(room)
    edge = BRAKING.stopping_m(4.0, 0.4)
    assert BRAKING.safe_velocity(0.4, edge) == 4.0
    assert BRAKING.safe_velocity(0.4, 100.0) == 4.0


def test_a_stop_beyond_the_measured_speeds_grows_with_the_energy() -> None:
    assert BRAKING.distance_from_m(0.0) == 0.0
    assert BRAKING.distance_from_m(0.5) == pytest.approx(0.25)
    assert BRAKING.distance_from_m(3.5) == pytest.approx(5.0)
    assert BRAKING.distance_from_m(7.0) == pytest.approx(20.0)


def test_the_reaction_is_the_sum_of_its_stages() -> None:
    # A frame, its way, two inferences, a hold, the link, a tick of 4 ms.
    assert LOOP.reaction_s(0.1) == pytest.approx(0.033 + 0.005 + 0.1 + 0.5 + 0.1 + 0.004 + 0.004)
    assert LOOP.inference_s(LOOP.reaction_s(0.25)) == pytest.approx(0.25)
    assert LOOP.inference_s(0.0) == pytest.approx(-0.5 * LOOP.reaction_s(0.0))


def test_the_loop_of_a_vehicle_has_its_camera_and_the_delays() -> None:
    delay = Delay(transport_ms=7.0, link_ms=9.0)
    loop = DecisionLoop.of(QUAD, 0.25, delay)
    period_s = QUAD.camera.period_us / 1e6
    found = (loop.frame_period_s, loop.transport_s, loop.hold_s, loop.link_s)
    assert found == pytest.approx((period_s, 0.007, 0.25, 0.009))
    plain = Delay()
    assert DecisionLoop.of(QUAD, 0.25) == DecisionLoop.of(QUAD, 0.25, plain)
    assert DecisionLoop.of(QUAD, 0.25).transport_s == pytest.approx(plain.transport_ms / 1000.0)


def test_the_room_ends_at_the_hull() -> None:
    overhang = 0.5 * QUAD.body.width_m - QUAD.camera.forward_m
    task = StoppingTask(QUAD, LOOP, 8.0)
    assert task.room_m == pytest.approx(8.0 - overhang)
    speed = task.safe_velocity(0.05)
    braking = braking_of(QUAD)
    assert braking.stopping_m(speed, LOOP.reaction_s(0.05)) == pytest.approx(task.room_m)
    assert task.inference_budget_s(speed) == pytest.approx(0.05, abs=1e-6)
    # Without any room for an inference the budget is negative.
    assert StoppingTask(QUAD, LOOP, 1.0).inference_budget_s(speed) < 0.0


def test_an_obstacle_within_the_hull_is_refused() -> None:
    overhang = 0.5 * QUAD.body.width_m - QUAD.camera.forward_m
    for distance in (overhang, 0.5 * overhang):
        with pytest.raises(FieldError, match=f"value > {overhang:g} m"):
            StoppingTask(QUAD, LOOP, distance).safe_velocity(0.05)
    assert StoppingTask(QUAD, LOOP, overhang + 0.01).safe_velocity(0.05) > 0.0


def test_a_bound_scales_faster_actions_alone() -> None:
    slow = SpeedBound(0.61, 8.0, 2.0, 4.0)
    assert slow.max_speed_m_s == 2.0
    assert slow.describe() == (
        "safe velocity 2.00 m/s (reaction 0.610 s, sensing distance 8 m, braking as measured): "
        "actions scaled by 0.500, from 4 m/s"
    )
    for asked in (2.0, 1.5):
        same = SpeedBound(0.61, 8.0, 2.0, asked)
        assert same.max_speed_m_s == asked
        assert same.describe().endswith(
            f"above the fastest action, {asked:g} m/s: actions are not scaled"
        )


def test_the_sources_of_the_inference_time() -> None:
    several = injections_of(Delay(latency=("80ms", "120ms")))
    assert [each.latency.mean_ms for each in several if each.latency] == [80.0, 120.0]
    (own,) = injections_of(Delay(computer="ras-pi-4", workload="template-5x32"))
    assert own.latency is not None
    assert own.latency.mean_ms == 396.0
    (native,) = injections_of(Delay())
    assert native.latency is None


def test_open_space_has_nothing_in_reach() -> None:
    batch = open_space(3, obstacles=2)
    assert batch.n_static.tolist() == [2, 2, 2]
    west, east, south, north = batch.bounds[0, :4]
    assert (batch.bounds == batch.bounds[0]).all()
    assert west == south == -east == -north
    assert east >= 1000.0
    assert batch.bounds[0, 4] == pytest.approx(0.001)
    assert batch.bounds[0, 5] == 0.0
    assert batch.goal[:, 0].tolist() == [-east] * 3
    assert batch.goal[:, 1].tolist() == [0.0] * 3
