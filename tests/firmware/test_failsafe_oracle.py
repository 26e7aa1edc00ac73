"""Failsafes against PX4's own compiled code: outcomes that scripts/failsafe_oracle.py recorded."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from airl_mav.profiles.px4_release import FailsafeRules, px4_release
from failsafe_oracle import Compared, Outcome, Table, compare, episode, kind
from firmware_sim.autopilot.events.definition import FailsafeAction

RECORDED = sorted((Path(__file__).parents[1] / "support" / "failsafe_oracle").glob("*.json"))


def rules_of(recorded: Mapping[str, Any]) -> FailsafeRules:
    rules = px4_release(recorded["release"]).failsafes
    return rules._replace(**dict.fromkeys(recorded["without"], False))


def replayed(recorded: Mapping[str, Any], rules: FailsafeRules) -> list[Compared]:
    """Return each input with PX4's outcome and the table's."""
    outcomes = iter(recorded["outcomes"])

    def answer(line: Mapping[str, Any]) -> Mapping[str, Any]:
        return {} if "reset" in line else dict(zip(Outcome._fields, next(outcomes), strict=True))

    found: list[Compared] = []
    rng, table = np.random.default_rng(recorded["seed"]), Table(rules)
    while len(found) < len(recorded["outcomes"]):
        found += compare(episode(rng), answer, table)
    return found


@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.stem)
def test_outcomes_are_those_of_px4s_code(path: Path) -> None:
    recorded = json.loads(path.read_text(encoding="utf-8"))
    found = replayed(recorded, rules_of(recorded))
    assert len(found) >= 400
    assert [kind(line, px4, here) for line, px4, here in found if px4 != here] == []
    # The sample has every action.
    assert {px4.action for _, px4, _ in found} == set(map(int, FailsafeAction))


@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.stem)
def test_the_comparison_finds_another_rule(path: Path) -> None:
    recorded = json.loads(path.read_text(encoding="utf-8"))
    rules = rules_of(recorded)
    for name, value in rules._asdict().items():
        if name in ("warning_has_text", "gcs_loss_needs_arming"):
            continue  # Not an outcome, or hidden while the vehicle is disarmed.
        other = rules._replace(**{name: (value + 1) % 3 if name == "delays_from" else not value})
        differing = [px4 != here for _, px4, here in replayed(recorded, other)]
        assert any(differing), name
