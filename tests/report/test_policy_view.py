"""Recomputed observations and decisions of the policy, compared with its flights."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from airl_mav.policy.card import CARD_FILE
from airl_mav.rehearsal.run_folder import LoadedRun, arenas_of, load, vehicle_of
from airl_mav.report.policy_view import SeenDecision, policy_again, seen_decisions
from tests.support.command_line import airl, option_words
from tests.support.linear_policy import write_linear


def fly(policy: Path, out: Path, **options: object) -> LoadedRun:
    """Fly a policy at level gym, where it sees the true state and no noise."""
    asked = {"arena": "dense-obstacles", "episodes": 4, "seed": 20, "out": out, **options}
    code, _ = airl("evaluate", str(policy), *option_words(**asked))
    assert code == 0
    return load(out)


def seen_in(run: LoadedRun) -> list[SeenDecision]:
    vehicle = vehicle_of(run.info)
    arenas, again = arenas_of(run.episodes, vehicle), policy_again(run.info)
    return [
        decision
        for record in run.episodes
        for decision in seen_decisions(run, record, arenas[record.index], vehicle, again)
    ]


@pytest.fixture(scope="module")
def linear(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_linear(tmp_path_factory.mktemp("policy") / "linear")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, linear: Path) -> LoadedRun:
    return fly(linear, tmp_path_factory.mktemp("seen") / "run")


@pytest.fixture(scope="module")
def compensated(tmp_path_factory: pytest.TempPathFactory, linear: Path) -> LoadedRun:
    out = tmp_path_factory.mktemp("seen") / "late"
    late = {"computer": "ras-pi-4", "workload": "template-5x32", "compensate": True}
    return fly(linear, out, **late)


def test_the_policy_asked_again_chooses_what_it_flew(flown: LoadedRun) -> None:
    decisions = seen_in(flown)
    # Those after the outcome are no part of the flight.
    sent = ((flown.latency[e.index]["sent_us"], e.ended_us) for e in flown.episodes)
    assert len(decisions) == sum(int((times <= end_us).sum()) for times, end_us in sent)
    assert len({int(np.argmax(d.scores)) for d in decisions if d.scores is not None}) > 2
    # Frames were exposed between the samples of the path, 20 ms apart.
    again = [d.again for d in decisions]
    assert sum(map(bool, again)) >= 0.9 * len(again)


@pytest.mark.nightly
def test_so_it_does_where_its_latency_was_compensated(compensated: LoadedRun) -> None:
    decisions = seen_in(compensated)
    assert len(decisions) > 20
    assert sum(bool(d.again) for d in decisions) >= 0.8 * len(decisions)
    # Without the compensation it would have seen other images, and often have chosen otherwise.
    config = dict(compensated.info.config)
    config["pilot"] = {**config["pilot"], "compensate": False}
    plain = seen_in(replace(compensated, info=replace(compensated.info, config=config)))
    assert sum(bool(d.again) for d in plain) < sum(bool(d.again) for d in decisions)


def test_what_is_not_the_policy_that_flew_is_not_asked(
    flown: LoadedRun, tmp_path: Path, linear: Path
) -> None:
    def asked(**changes: object) -> object:
        config = {**flown.info.config, **changes}
        return policy_again(replace(flown.info, config=config))

    assert asked() is not None
    assert asked(policy="greedy", policy_sha256=None) is None
    assert asked(policy=f"{tmp_path}/mine.py:Mine") is None
    assert asked(policy=str(tmp_path / "gone")) is None
    assert asked(policy_sha256="0" * 64) is None
    # A card that names code is not read for it.
    card = json.loads((linear / CARD_FILE).read_text(encoding="utf-8"))
    assert card["sha256"] == flown.info.config["policy_sha256"]


def test_a_flight_without_its_recording_shows_nothing(flown: LoadedRun) -> None:
    assert seen_in(replace(flown, trajectories={})) == []
    assert seen_in(replace(flown, latency={})) == []
