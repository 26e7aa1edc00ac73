"""Policies that command body rates or an attitude, flown from the twin to MAVSDK."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from airl_mav import Scenario, rehearse
from airl_mav.addons.recordings.recorded_flight import path_of, stamps_of
from airl_mav.black_box.mcap_file import read_black_box
from airl_mav.core.frames import quat_to_euler
from airl_mav.flight.judge import Outcome
from airl_mav.latency.stamps import NO_STAMP, SETPOINTS, commanded
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.policy.actions import Attitude, BodyRates
from airl_mav.policy.observation import Observation
from airl_mav.rehearsal.run_folder import FlownEpisode, load
from airl_mav.scenario.resolve import resolve
from airl_mav.vehicle_log import align, read_vehicle_log
from tests.support.processes import ROOT
from tests.support.recorded_flights import fly_recorded

POLICY = f"{ROOT / 'examples' / 'own_body_rates.py'}:ToGoal"


class Leaning:
    """Leans by 10 degrees towards a goal, heading north all the way."""

    commands = "attitude"

    def act(self, seen: Observation) -> Attitude:
        position, velocity = seen.states[0].position, seen.states[0].velocity
        c, s = math.cos(seen.yaw), math.sin(seen.yaw)
        forward, right = seen.goal
        away = math.hypot(forward, right)
        towards = np.array([c * forward - s * right, s * forward + c * right]) / max(away, 1e-6)
        wanted = min(3.0, 0.8 * away) * towards
        lean = np.clip(0.2 * (wanted - velocity[:2]), -0.18, 0.18)
        climb = 0.15 * (2.5 + position[2]) + 0.1 * velocity[2]
        return Attitude(float(lean[1]), -float(lean[0]), 0.0, 0.5 + 0.1 * climb)


class Broken:
    """Gives what is no number after a while."""

    commands = "body_rates"

    def __init__(self) -> None:
        self.decisions = 0

    def act(self, _seen: Observation) -> BodyRates:
        self.decisions += 1
        rate = math.nan if self.decisions > 40 else 0.0
        return BodyRates(0.0, rate, 0.0, 0.5)


class Mixed:
    """Says that it commands body rates, and commands an attitude."""

    commands = "body_rates"

    def act(self, _seen: Observation) -> Attitude:
        return Attitude(0.0, 0.0, 0.0, 0.5)


def flown(policy: str, seed: int = 1, **asked: Any) -> FlownEpisode:
    scenario = {"policy": policy, "arena": "no-obstacles", "level": "lockstep"} | asked
    resolved = resolve(Scenario.model_validate(scenario))
    return fly(resolved, resolved.fresh_policy(seed), 0, seed)


def times(runs: Sequence[Any]) -> np.ndarray:
    return np.array([[e.quality.flight_time_s, e.quality.distance_m] for e in runs])


def test_by_body_rates_to_the_goal_at_every_level_alike(tmp_path: Path) -> None:
    """The twin has no MAVLink, estimator or take-off, and flies the same: PX4 does, too."""
    seen = {}
    for level in ("gym", "lockstep"):
        asked = Scenario(policy=POLICY, arena="no-obstacles", level=level, episodes=4)
        rehearse(asked, out=tmp_path / level)
        run = load(tmp_path / level)
        assert [each.outcome for each in run.episodes] == [Outcome.SUCCESS] * 4
        seen[level] = times(run.episodes)
        for columns in run.latency.values():
            assert "setpoint" not in columns
            rates = columns["rates_setpoint"]
            assert 0.4 < rates[:, 3].mean() < 0.65
            assert np.abs(rates[:, :3]).max() > 0.5
    np.testing.assert_allclose(seen["gym"], seen["lockstep"], rtol=0.03)


def test_one_flight_of_body_rates() -> None:
    one, again = flown(POLICY), flown(POLICY)
    assert one.record.sha256 == again.record.sha256
    assert one.record.outcome is Outcome.SUCCESS
    stamps = one.latency
    accepted, motors = stamps["accepted_us"], stamps["motor_us"]
    assert (accepted != NO_STAMP).all()
    # In the motors at the next tick: neither the velocity nor the attitude loop is waited for.
    assert (motors - accepted <= 4_000).mean() > 0.99
    # A decision for every image.
    assert np.median(np.diff(stamps["sent_us"])) == pytest.approx(33_000, abs=4_000)
    assert one.record.quality is not None
    assert one.record.quality.command_jerk_rms_m_s3 is None
    assert one.record.quality.jerk_rms_m_s3 is not None


def test_late_body_rates_end_in_the_floor_where_late_velocities_fly() -> None:
    late = flown(POLICY, latency="120ms")
    assert late.record.outcome is Outcome.COLLISION
    assert flown("greedy", latency="120ms").record.outcome is Outcome.SUCCESS


@pytest.mark.parametrize("policy", [POLICY, f"{__name__}:Leaning"])
def test_the_vehicles_log_tells_when_setpoints_came(tmp_path: Path, policy: str) -> None:
    scenario = Scenario(policy=policy, arena="no-obstacles", level="lockstep", latency="5ms")
    flight = fly_recorded(resolve(scenario), 1, tmp_path)
    assert flight.reason == "goal reached"
    box, log = read_black_box(flight.black_box), read_vehicle_log(flight.ulg)
    stamps = stamps_of(box)
    kind = commanded(stamps)
    setpoints = np.asarray(stamps[SETPOINTS[kind]], np.float64)
    clocks = align(path_of(box), log, stamps["sent_us"], setpoints, kind)
    assert clocks.setpoints > 40
    assert clocks.accepted_range_us is not None
    taken = flight.part("setpoints")
    ways = []
    for sent_us, setpoint in zip(stamps["sent_us"], setpoints, strict=True):
        same = np.abs(taken["setpoint"] - setpoint).max(axis=1) < 1e-5
        after = taken["accepted_us"][same & (taken["accepted_us"] >= sent_us)]
        ways += (after[:1] - sent_us).tolist()
    first_us, last_us = clocks.accepted_range_us
    assert len(ways) > 0.9 * len(setpoints)
    assert first_us <= np.median(ways) <= last_us
    assert last_us - first_us <= 25_000
    # The log contains no velocity setpoints.
    with_none = align(path_of(box), log, stamps["sent_us"], setpoints)
    assert with_none.setpoints < 10


@pytest.mark.parametrize("seed", [1, 2])
def test_overdue_body_rates_are_replaced_by_a_stand(tmp_path: Path, seed: int) -> None:
    """One decision in 31 takes a second: the vehicle stops rotating and stays in the air."""
    latencies = tmp_path / "stalls.txt"
    latencies.write_text("5\n" * 30 + "1000\n")
    late = flown(POLICY, seed, latency=str(latencies))
    assert late.record.outcome is Outcome.SUCCESS
    assert "velocity zeroed" in " ".join(late.record.notes)
    assert "left offboard" not in " ".join(late.record.notes)
    tilts = [math.hypot(*quat_to_euler(q)[:2]) for q in late.trajectory.quaternion]
    assert math.degrees(max(tilts)) < 60.0


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("latency", "asked", "close"),
    [
        # Each decision is overdue: replaced, and followed again where PX4's control mode has it.
        ("230ms", {}, 0.12),
        # Stalls are survived at both.
        ("stalls", {}, 0.08),
        ("stalls", {"decisions": "sequential", "hold_s": 0.07}, 0.15),
    ],
)
def test_overdue_decisions_cost_the_twin_what_they_cost_the_companion(
    tmp_path: Path, latency: str, asked: dict[str, Any], close: float
) -> None:
    stalls = tmp_path / "stalls.txt"
    stalls.write_text("5\n" * 30 + "1000\n")
    flights = {}
    for level in ("gym", "lockstep"):
        known = {"policy": POLICY, "arena": "no-obstacles", "level": level, "episodes": 4} | asked
        known["latency"] = str(stalls) if latency == "stalls" else latency
        rehearse(Scenario(**known), out=tmp_path / level)
        run = load(tmp_path / level)
        flights[level] = run.episodes
    ends = [each.outcome for each in flights["gym"]]
    assert [each.outcome for each in flights["lockstep"]] == ends
    assert set(ends) == {Outcome.COLLISION if latency == "230ms" else Outcome.SUCCESS}
    mean = [times(each)[:, 0].mean() for each in flights.values()]
    assert mean[0] == pytest.approx(mean[1], rel=close)


def test_an_attitude_is_flown_and_told_as_such() -> None:
    leaning = flown(f"{__name__}:Leaning")
    assert leaning.record.outcome is Outcome.SUCCESS
    asked = leaning.latency["attitude_setpoint"]
    assert "setpoint" not in leaning.latency
    assert (leaning.latency["accepted_us"] != NO_STAMP).all()
    # Attitudes follow the setpoints from one second after the first setpoint.
    path, sent = leaning.trajectory, leaning.latency["sent_us"]
    later = sent > sent[0] + 1_000_000
    rows = np.searchsorted(path.time_us, sent[later] + 150_000)
    angles = np.array([quat_to_euler(q) for q in path.quaternion[rows.clip(max=len(path) - 1)]])
    assert np.abs(angles[:, :2] - asked[later, :2]).mean() < math.radians(3.0)
    assert np.abs(angles[:, 2]).max() < math.radians(5.0)


@pytest.mark.parametrize(
    ("policy", "reason"),
    [
        ("Broken", "policy failed: ValueError: it returned what is no number"),
        ("Mixed", "policy failed: TypeError: it returned Attitude; accepted: BodyRates"),
    ],
)
def test_what_cannot_be_flown_lands_the_vehicle(
    policy: str, reason: str, capfd: pytest.CaptureFixture[str]
) -> None:
    ended = flown(f"{__name__}:{policy}")
    assert ended.record.outcome is Outcome.ABORTED
    assert reason in ended.record.reason
    assert ended.trajectory.position[-1, 2] > -0.3
    assert "Error: it returned" in capfd.readouterr().err
