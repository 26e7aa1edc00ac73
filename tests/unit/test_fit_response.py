"""`scripts/fit-response`: a response is found again in the steps that it flies."""

from __future__ import annotations

import math
import runpy
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from airl_mav.addons.conformance.result import ConformanceResult, ConformanceSettings, StoredStep
from airl_mav.addons.conformance.telemetry import (
    MANOEUVRES,
    MeasuredStep,
    SetpointStep,
    StepName,
    StepResponse,
    step_response,
)
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.profiles.loading import profiles_dir
from airl_mav.profiles.vehicle import Response, load_vehicle
from fitted_response import fit_response, load_steps
from tests.support.processes import ROOT

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

QUAD = load_vehicle("quad")
STEPS = {leg.step.name: leg.step for legs in MANOEUVRES for leg in legs if leg.step is not None}


def flown(step: SetpointStep, dead_s: float, lag_s: float) -> StepResponse:
    """Return the figures of a first-order lag with dead time, sampled at 500 Hz."""
    times_s = np.arange(-0.5, 6.0, 0.002)
    done = 1.0 - np.exp(-np.maximum(times_s - dead_s, 0.0) / lag_s)
    values = step.before + (step.after - step.before) * done
    return step_response(times_s, values, step.before, step.after, 1e-3)


def steps_of(dead_s: float, lag_s: float, turn_lag_s: float) -> dict[StepName, MeasuredStep]:
    found = {}
    for name, step in STEPS.items():
        lag = turn_lag_s if name == "yawspeed-30" else lag_s
        # Steps upwards are another loop's; they must not count.
        dead = 0.9 if step.quantity == "down" else dead_s
        found[name] = MeasuredStep(step, [flown(step, dead, lag)])
    return found


def result(tmp_path: Path, steps: Mapping[StepName, MeasuredStep]) -> str:
    """Write what `airl conformance --out` writes."""
    settings = ConformanceSettings(steps=(), steps_only=True)
    path = tmp_path / "steps.json"
    ConformanceResult(settings, steps=dict(steps)).write(path)
    return str(path)


@pytest.mark.parametrize("asked", [(0.19, 0.47, 0.1), (0.05, 0.2, 0.3), (0.4, 1.1, 0.25)])
def test_the_response_is_found_again(asked: tuple[float, float, float], tmp_path: Path) -> None:
    found = fit_response(load_steps(result(tmp_path, steps_of(*asked))), QUAD)
    times = (found.dead_time_s, found.velocity_time_s, found.yaw_rate_time_s)
    # Times are late by up to a sample.
    assert times == pytest.approx(asked, abs=0.003)
    assert found.drag_1_s == pytest.approx(0.25 / 1.5, abs=5e-4)


def test_of_steps_that_disagree_it_is_the_least_squares_fit() -> None:
    """Against numpy's polynomial fit of the times over -ln(1 - share)."""
    rng = np.random.default_rng(1)
    names: tuple[StepName, ...] = ("north-2", "east-2", "yawspeed-30")
    t10_s, t50_s, rise_s = rng.uniform([0.1, 0.4, 0.7], [0.2, 0.6, 1.2], (3, 3)).T
    steps = {
        name: StoredStep(t10_s=t10_s[k], t50_s=t50_s[k], rise_s=rise_s[k])
        for k, name in enumerate(names)
    }
    found = fit_response(steps, QUAD)
    lags = [-math.log(1.0 - share) for share in (0.1, 0.5, 0.9)]
    times = np.column_stack([t10_s, t50_s, t10_s + rise_s])
    # The velocity by 10 and 50 %, the yaw rate also by 90 %.
    lag_s, dead_s = np.polyfit(lags[:2] * 2, times[:2, :2].ravel(), 1)
    assert (found.dead_time_s, found.velocity_time_s) == pytest.approx((dead_s, lag_s), abs=5e-4)
    turn = np.polyfit(lags, times[2], 1)
    assert found.yaw_rate_time_s == pytest.approx(turn[0], abs=5e-4)
    assert found.yaw_rate_dead_time_s == pytest.approx(turn[1], abs=5e-4)


def test_the_shipped_quad_has_what_the_script_prints(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = ROOT / "scripts" / "fit-response"
    monkeypatch.setattr(sys, "argv", [str(script), "px4-1.17", "--vehicle", "quad"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert validated(Response, tomllib.loads(printed)["response"]) == QUAD.response
    assert printed in (profiles_dir() / "vehicles" / "quad.toml").read_text()


@pytest.mark.parametrize(
    ("left_out", "words"),
    [("north", "accepted: with north-2 or"), ("yawspeed-30", "accepted: with yawspeed-30, up to")],
)
def test_without_its_steps_nothing_is_found(left_out: str, words: str) -> None:
    """A step does not count that does not reach 50 %, of the yaw rate 90 %."""
    horizontal = ("north", "east", "forward")
    left = horizontal if left_out == "north" else (left_out,)
    all_steps = {
        name: StoredStep(t10_s=0.2, t50_s=0.5, rise_s=1.0)
        for name in STEPS
        if not name.startswith(left)
    }
    if left_out == "yawspeed-30":
        all_steps["yawspeed-30"] = StoredStep(t10_s=0.2, t50_s=0.5, rise_s=None)
    with pytest.raises(UsageError, match=words):
        fit_response(all_steps, QUAD)


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("nowhere", "no conformance profile 'nowhere'"),
        ("missing.json", "no result of airl conf"),
        ("other.json", "other.json: steps"),
    ],
)
def test_a_source_that_cannot_be_used_is_one_line(
    source: str,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "other.json").write_text('{"schema": 1}')
    monkeypatch.chdir(tmp_path)
    script = ROOT / "scripts" / "fit-response"
    monkeypatch.setattr(sys, "argv", [str(script), source])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
