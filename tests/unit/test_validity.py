"""Flights that are not a valid test of the policy, and the reasons."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from airl_mav.flight.judge import RULES, HostFigures, Rule, host_faults, host_figures
from airl_mav.latency.stamps import NO_STAMP

GOOD = HostFigures(
    given_up=0.0, tick_lateness_ms=2.0, speed=1.0, stale_frames=0.0, late_decisions=0.0
)
PERIOD_US = 33_333


def figures(**changes: object) -> HostFigures:
    """Return the figures of a flight of 10 s at speed 4, in step, with `changes` applied."""
    infer = np.arange(10, dtype=np.int64) * 550_000
    settings: dict[str, object] = {
        "flight_us": 10_000_000,
        "slipped_us": 0,
        "wall_s": 2.5,
        "speed": 4.0,
        "lateness_us": np.full(2500, 1_000),
        "decisions": {
            "capture_us": infer - 20_000,
            "infer_start_us": infer,
            "held_until_us": infer + 520_000,
        },
        "frame_period_us": PERIOD_US,
    }
    return host_figures(**(settings | changes))  # type: ignore[arg-type]


def test_a_host_that_keeps_pace_is_no_fault() -> None:
    assert host_faults(GOOD) == ()
    assert host_faults(figures()) == ()
    assert figures().speed == pytest.approx(1.0)


def test_every_rule_has_its_figure_and_every_figure_its_rule() -> None:
    assert {rule.figure for rule in RULES} == {field.name for field in fields(HostFigures)}


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: str(rule.figure))
def test_each_rule_judges_alone_on_its_own_side_of_the_limit(rule: Rule) -> None:
    off = 0.9 if rule.least else 1.1
    (fault,) = host_faults(replace(GOOD, **{rule.figure: rule.limit * off}))
    assert f"limit {rule.scale * rule.limit:g}" in fault
    assert host_faults(replace(GOOD, **{rule.figure: rule.limit / off})) == ()
    assert host_faults(replace(GOOD, **{rule.figure: rule.limit})) == ()


def test_what_was_given_up_is_a_share_of_all_that_passed() -> None:
    assert figures(slipped_us=2_500_000, wall_s=3.125).given_up == pytest.approx(0.2)
    assert host_faults(figures(slipped_us=2_500_000)) == (
        "20.0 % of its simulated time was given up (limit 1 %)",
    )


def test_a_flight_of_no_time_has_given_up_what_passed() -> None:
    assert figures(flight_us=0, slipped_us=0).given_up == 0.0
    assert figures(flight_us=0, slipped_us=1).given_up == 1.0


def test_a_host_at_half_the_speed_is_named() -> None:
    assert host_faults(figures(wall_s=5.0)) == (
        "flown at 50 % of the speed asked for (limit 95 %)",
    )


def test_late_ticks_are_those_of_the_hundredth() -> None:
    late = np.full(2500, 1_000)
    late[:20] = 300_000
    assert host_faults(figures(lateness_us=late)) == (), "less than one in a hundred"
    late[:60] = 300_000
    assert host_faults(figures(lateness_us=late)) == (
        "1 % of ticks began 300 ms late (limit 40 ms)",
    )


def test_what_a_fault_makes_late_is_not_the_host_s() -> None:
    infer = np.arange(10, dtype=np.int64) * 550_000
    infer[5:] += 2_000_000  # The companion stood still from 2.3 s to 4.6 s.
    decisions = {
        "capture_us": infer - 20_000,
        "infer_start_us": infer,
        "held_until_us": np.arange(10) * 550_000 + 520_000,
    }
    assert figures(decisions=decisions).late_decisions == pytest.approx(5 / 9)
    decisions["held_until_us"][5:] += 2_000_000
    assert figures(decisions=decisions).late_decisions == pytest.approx(1 / 9)
    assert figures(decisions=decisions, excused=[(2_300_000, 4_600_000)]).late_decisions == 0.0
    assert figures(decisions=decisions, excused=[(5_300_000, 5_400_000)]).late_decisions == 1 / 8


def test_old_frames_and_late_decisions_are_counted() -> None:
    infer = np.arange(10, dtype=np.int64) * 550_000
    old = infer - 20_000
    old[3] = infer[3] - 4 * PERIOD_US
    decisions = {"capture_us": old, "infer_start_us": infer, "held_until_us": infer + 520_000}
    assert figures(decisions=decisions).stale_frames == pytest.approx(0.1)
    decisions["capture_us"] = infer
    decisions["held_until_us"] = infer + 400_000
    assert figures(decisions=decisions).late_decisions == 1.0


def test_stamps_that_never_came_are_no_intervals() -> None:
    infer = np.arange(4, dtype=np.int64) * 550_000
    never = np.full(4, NO_STAMP)
    got = figures(decisions={"capture_us": never, "infer_start_us": infer, "held_until_us": never})
    assert (got.stale_frames, got.late_decisions) == (None, None)
    assert host_faults(figures(decisions={}, lateness_us=np.zeros(0), wall_s=None)) == ()
