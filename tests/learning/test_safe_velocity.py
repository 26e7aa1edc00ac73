"""The safe velocity is safe: the measured braking, and flights that have to stop."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from airl_mav.addons.roofline.page import fly_into, greatest_speed, noticed_m
from airl_mav.core.errors import FieldError
from airl_mav.envs import stopping
from airl_mav.envs.fleet import FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import spec_of
from airl_mav.envs.stopping import (
    Braking,
    DecisionLoop,
    StoppingTask,
    bounded,
    braking_of,
    measure_braking,
    speed_bound,
)
from airl_mav.envs.vector import NavigationVectorEnv
from airl_mav.latency.injection import longest_ms, parse_latency
from airl_mav.policy.registry import load_learned
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import load_profile, profile_digest, profiles_dir
from airl_mav.profiles.vehicle import Payload, load_vehicle, loaded
from airl_mav.training.config import TrainingConfig
from tests.support.flight_rig import NAN, flight, velocity_setpoint
from tests.support.processes import ROOT

QUAD = load_vehicle("quad")
PI = {"computer": "ras-pi-4", "workload": "template-5x32"}
SOURCES = (("1ms", 0.5), ("150ms", 0.5), ("ras-pi-4/template-5x32", 0.25))
"""A source of t2, and the hold of the policies that fly with it [s]."""


def task_of(hold_s: float, distance_m: float = 8.0) -> StoppingTask:
    loop = DecisionLoop(QUAD.camera.period_us / 1e6, 0.005, hold_s, 0.004)
    return StoppingTask(QUAD, loop, distance_m)


def test_the_page_has_the_safe_velocities() -> None:
    page = (ROOT / "docs" / "how-to" / "latency.md").read_text(encoding="utf-8")
    table = page[page.index("| quad, D = 8 m |") :].split("\n\n")[0].splitlines()[2:]
    told = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    for (title, reaction, velocity), (source, hold_s) in zip(told, SOURCES, strict=True):
        latency = parse_latency(source).latency
        assert latency is not None
        task, t2_s = task_of(hold_s), longest_ms(latency) / 1e3
        assert title.endswith(f"hold {hold_s:g} s")
        assert reaction == f"{task.loop.reaction_s(t2_s):.2f} s"
        assert velocity == f"{task.safe_velocity(t2_s):.2f} m/s"


# --- braking


@pytest.fixture(scope="module")
def measured() -> Braking:
    return measure_braking(QUAD)


def test_the_measured_way_is_that_of_the_autopilot_in_pybullet(measured: Braking) -> None:
    """Another plant, the estimator's velocity in place of the true one, and one flight of each."""
    with flight(seed=3) as rig:
        rig.take_off(2.5, 1.0)
        rig.go_offboard(velocity_setpoint(0.0, 0.0, 0.0, yaw=NAN, yaw_rate=0.0))
        for wanted in (2.0, 5.0):
            rig.stream(velocity_setpoint(wanted, 0.0, 0.0, yaw=NAN, yaw_rate=0.0))
            rig.run(2.5)
            speed, start = rig.truth.velocity[0], rig.truth.position[0]
            rig.stream(velocity_setpoint(0.0, 0.0, 0.0, yaw=NAN, yaw_rate=0.0))
            rig.until(lambda: rig.truth.velocity[0] <= 0.0, 20.0)
            way = float(rig.truth.position[0] - start)
            at = measured.commanded_m_s.index(wanted)
            assert way == pytest.approx(measured.distance_m[at], rel=0.05)
            assert speed <= measured.flown_m_s[at] * 1.02
            rig.run(1.5)


def test_a_stop_takes_over_three_times_what_the_tilt_limit_gives(
    measured: Braking,
) -> None:
    assert measured.distance_from_m(4.08) == pytest.approx(2.87, abs=0.08)
    assert 4.08**2 / (2.0 * 9.80665) < 0.9  # the tilt limit's
    ways, flown = np.array(measured.distance_m), np.array(measured.flown_m_s)
    assert (np.diff(ways) > 0.0).all()
    # At 12 m/s the tilt limit holds the vehicle back: its drag helps, and it must lean first.
    assert measured.fastest_m_s == 12.0
    assert ways[-1] > flown[-1] ** 2 / (2.0 * 9.80665)
    assert measured.distance_from_m(24.0) == pytest.approx(
        ways[-1] * (24.0 / flown[-1]) ** 2, rel=1e-9
    )


def test_it_is_measured_once_for_each_load(
    measured: Braking, monkeypatch: pytest.MonkeyPatch
) -> None:
    heavy = loaded(QUAD, load_computer("ras-pi-4"), Payload(mass_g=300.0))
    assert heavy.body.mass_kg == pytest.approx(1.846)
    carrying = braking_of(heavy)
    assert carrying.vehicle_sha256 == profile_digest(heavy) != measured.vehicle_sha256
    assert braking_of(QUAD) == measured
    assert carrying.distance_m != measured.distance_m
    calls: list[str] = []
    monkeypatch.setattr(stopping, "measure_braking", lambda _: calls.append("measured"))
    stopping._braking.cache_clear()  # as another process would find it
    assert braking_of(heavy) == carrying
    assert not calls


def test_a_damaged_measurement_is_measured_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(stopping, "cache_folder", lambda _: tmp_path)
    stopping._braking.cache_clear()
    first = braking_of(QUAD)
    (stored,) = tmp_path.glob("braking-*.json")
    held = json.loads(stored.read_text(encoding="utf-8"))
    assert held["vehicle_sha256"] == profile_digest(QUAD)
    stored.write_text(stored.read_text(encoding="utf-8").replace("8.0", "8.1"), encoding="utf-8")
    stopping._braking.cache_clear()
    assert braking_of(QUAD) == first
    stopping._braking.cache_clear()


# --- the worst moment


@pytest.mark.parametrize(("source", "hold_s"), SOURCES)
def test_at_the_safe_velocity_nothing_is_touched_and_a_tenth_faster_something_is(
    source: str, hold_s: float
) -> None:
    task, latency = task_of(hold_s), parse_latency(source)
    assert latency.latency is not None
    v = task.safe_velocity(longest_ms(latency.latency) / 1e3)
    assert 1.0 < v < 12.0
    assert not fly_into(task, v, latency, 0.001, 1000, 1).any()
    assert fly_into(task, 1.1 * v, latency, 0.001, 1000, 1).any()


def test_the_greatest_speed_lies_between_the_two() -> None:
    task, latency = task_of(0.5), parse_latency("150ms")
    v = task.safe_velocity(0.15)
    found = greatest_speed(task, latency, 0.001, 50, 1)
    assert v <= found < 1.03 * v
    assert found == greatest_speed(task, latency, 0.001, 50, 1)


def test_the_whole_loop_with_its_camera_stops_in_time() -> None:
    """Fly rendered depth and real decisions: full speed until the wall is nearer than D, then 0.

    Each flight has a different D, so that decisions occur at all times before the wall.
    """
    flights = 100
    distances = np.linspace(6.0, 10.0, flights)
    safe = np.array([task_of(0.5, d).safe_velocity(0.15) for d in distances])

    def touched(speeds: NDArray[np.float64]) -> int:
        spec = spec_of(None, {"arena": "no-obstacles", "delay": {"latency": ("150ms",)}})
        navigation = Navigation(spec, flights)
        navigation.begin(range(flights), range(1, 1 + flights))
        commands = np.zeros((flights, 3))
        stopped = np.zeros(flights, np.bool_)
        for decision in range(25):
            ahead_mm = navigation.see().depth_mm[:, 24, 32]
            # At the start the vehicle leans so far that the camera sees the floor.
            near = (ahead_mm > 0) & (ahead_mm < 1e3 * distances) & (decision > 5)
            stopped |= near
            commands[:, 0] = np.where(stopped, 0.0, speeds)
            navigation.fly(commands)
        verdict = navigation.flights().verdict
        assert (stopped | (verdict == FlightStatus.SUCCESS)).all()
        return int((verdict == FlightStatus.COLLISION).sum())

    assert touched(safe) == 0
    assert touched(1.15 * safe) > 0


# --- the bound of an environment


def test_an_environment_is_bounded_by_its_longest_latency() -> None:
    spec = spec_of(None, {"delay": PI, "safe_velocity": {"sensing_distance_m": 8.0}})
    bound = speed_bound(spec)
    assert bound is not None
    # Twice 396 ms and 3.09 standard deviations of a log-normal of 5 %; 33.3 ms to the next frame,
    # 5 ms transport, 500 ms hold, 4 ms link, 4 ms to the next tick.
    assert bound.reaction_s == pytest.approx(2 * 0.4615 + 0.5463, abs=4e-3)
    tight = bounded(spec)
    assert tight.max_speed_m_s == bound.safe_velocity_m_s < 5.0
    assert bounded(tight) == tight
    share = tight.max_speed_m_s / 5.0
    assert f"actions scaled by {share:.3f}, from 5 m/s" in bound.describe()
    env = NavigationVectorEnv(1, delay=PI, safe_velocity={"sensing_distance_m": 8.0})
    assert env.environment.action_spec.max_speed_m_s == tight.max_speed_m_s


def test_a_bound_above_the_fastest_action_is_told_and_does_nothing() -> None:
    spec = spec_of(None, {"delay": PI, "safe_velocity": {"sensing_distance_m": 20.0}})
    bound = speed_bound(spec)
    assert bound is not None
    assert bounded(spec) == spec
    assert "actions are not scaled" in bound.describe()
    assert speed_bound(spec_of(None, {"delay": PI})) is None


def test_of_several_sources_the_longest_counts() -> None:
    sources = ("ras-pi-4/template-5x32", "900ms")
    safe = {"sensing_distance_m": 8.0}
    bound = speed_bound(spec_of(None, {"delay": {"latency": sources}, "safe_velocity": safe}))
    assert bound is not None
    assert bound.reaction_s == pytest.approx(2 * 0.9 + 0.5463, abs=1e-3)


def test_what_is_sensed_within_the_hull_gets_one_line() -> None:
    asked = {"delay": PI, "safe_velocity": {"sensing_distance_m": 0.1}}
    with pytest.raises(FieldError, match=r"sensing_distance_m 0\.1: accepted: value > 0\.155 m"):
        speed_bound(spec_of(None, asked))


def test_the_shipped_policy_is_bounded_by_what_it_takes_notice_of(tmp_path: Path) -> None:
    name = "static-obstacles-ras-pi-4"
    config = load_profile("training", name, TrainingConfig)
    # It was trained with the gains of PX4 1.16.
    shipped = (profiles_dir() / "vehicles" / "quad.toml").read_text(encoding="utf-8")
    quad = tmp_path / "quad.toml"
    quad.write_text(f'px4_release = "1.16"\n{shipped}', encoding="utf-8")
    bound = speed_bound(config.environment.model_copy(update={"vehicle": str(quad)}))
    assert bound is not None
    policy = load_learned(profiles_dir() / "policies" / name)
    assert policy.card.actions.max_speed_m_s == pytest.approx(bound.safe_velocity_m_s, rel=1e-4)
    assert noticed_m(policy, QUAD).min() > bound.sensing_distance_m


@pytest.mark.parametrize("t2_s", [0.05, 0.3, 0.46])
def test_the_budget_of_the_safe_velocity_is_the_inference_it_was_worked_out_for(
    t2_s: float,
) -> None:
    task = StoppingTask(QUAD, DecisionLoop.of(QUAD, hold_s=0.25), 6.0)
    speed = task.safe_velocity(t2_s)
    assert task.inference_budget_s(speed) == pytest.approx(t2_s, abs=1e-6)
    assert task.inference_budget_s(1.1 * speed) < t2_s
