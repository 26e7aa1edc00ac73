"""A busy host is reported before the flight."""

from __future__ import annotations

from typing import Any

import pytest

from airl_mav.rehearsal import host_pace
from airl_mav.scenario.model import Scenario
from firmware_sim.pacing import MAX_LAG_US

LATE = "a tick in a short test began 90 ms late (limit 20 ms)"


@pytest.mark.parametrize(
    ("asked", "warns"), [({}, True), ({"level": "lockstep"}, False), ({"validity": False}, False)]
)
def test_a_warning_names_what_the_host_may_make_invalid(
    asked: dict[str, Any], warns: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host_pace, "host_problem", lambda _speed: LATE)
    warning = host_pace.host_warning(Scenario(**asked))
    assert warning.endswith(f"does not keep real time: {LATE}" if warns else "")
    assert bool(warning) == warns


def test_work_that_takes_longer_than_a_tick_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_pace, "LOOPS", 0)
    punctual_ms = host_pace.greatest_lateness_ms(0.1, 5)
    monkeypatch.setattr(host_pace, "LOOPS", 4_000_000)
    late_ms = host_pace.greatest_lateness_ms(1.0, 20)
    assert 0.0 <= punctual_ms < late_ms
    assert late_ms >= MAX_LAG_US / 1e3


def test_the_check_measures_in_processes_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host_pace, "LATE_MS", -1.0)
    assert host_pace.host_problem(1.0).endswith(" ms late (limit -1 ms)")
