"""`airl roofline`: the F-1 model, the measured braking and the flights, on a page and in a file."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console
from scipy.optimize import brentq

from airl_mav.addons.roofline import roofline as command
from airl_mav.addons.roofline.page import Roofline, RooflinePoint, noticed_m
from airl_mav.addons.roofline.roofline import RooflineRequest, roofline
from airl_mav.core.errors import UsageError
from airl_mav.core.files import read_json
from airl_mav.policy.card import Runtime, read_card
from airl_mav.policy.registry import LearnedPolicy
from airl_mav.profiles.loading import profiles_dir
from airl_mav.profiles.vehicle import load_vehicle

BOARD = """
description = "a heavy board"
cpu = "any"
watts = 15.0
mass_g = 500.0
price_usd = 1.0
source = "made for this test"

[workloads.template-5x32]
source = "made for this test"
network = {image_height_px = 154, image_width_px = 256, parameters = 1, macs = 1, runtime = "none"}
latency = {distribution = "fixed", mean_ms = 11.0}
"""
SENSED_M, MISSION_M, HOLD_S = 8.0, 100.0, 0.25
QUAD = load_vehicle("quad")
CARD = read_card(profiles_dir() / "policies" / "static-obstacles")


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return the folder and output of one command with three computers and an untimed one."""
    folder = tmp_path_factory.mktemp("roofline")
    (folder / "heavy.toml").write_text(BOARD, encoding="utf-8")
    untimed = BOARD[: BOARD.index("[workloads")]
    (folder / "untimed.toml").write_text(untimed, encoding="utf-8")
    boards = (f"{folder / 'heavy.toml'}", f"{folder / 'untimed.toml'}")
    options = command.OPTIONS(
        policy="static-obstacles-ras-pi-4",
        computers=("ras-pi-4", "workstation", *boards),
        sensing_distance_m=SENSED_M,
        draws=20,
        out=folder / "out",
    )
    out = io.StringIO()
    assert command.run(options, Console(file=out, width=160)) == 0
    return folder / "out", out.getvalue()


@pytest.fixture(scope="module")
def found(shown: tuple[Path, str]) -> Roofline:
    data = read_json(shown[0] / command.RESULT_FILE, command.SCHEMA, "roofline")
    assert {"created_utc", "command", "versions", "machine"} <= set(data)
    return Roofline.model_validate({k: data[k] for k in Roofline.model_fields})


def of(found: Roofline, name: str) -> RooflinePoint:
    return next(point for point in found.points if point.computer == name)


@pytest.mark.nightly
def test_the_model_is_the_closed_form_of_the_reaction_time(found: Roofline) -> None:
    heavy = of(found, "heavy")
    period_s = 1.0 / 30.0 + 0.005 + 0.011 + HOLD_S + 0.011 + 0.004 + 0.004
    assert heavy.reaction_s == pytest.approx(period_s, abs=2e-6)
    assert sum(heavy.shares.model_dump().values()) == pytest.approx(heavy.reaction_s)
    room_m, a = SENSED_M + 0.12 - 0.275, 9.80665
    stops = brentq(lambda v: v * period_s + v * v / (2.0 * a) - room_m, 0.0, 100.0)
    assert heavy.f1_m_s == pytest.approx(stops, rel=1e-5)
    assert heavy.f1_roof_m_s == pytest.approx(math.sqrt(2.0 * a * room_m))


@pytest.mark.nightly
def test_every_computer_is_carried(found: Roofline) -> None:
    pi, ground, heavy = (of(found, name) for name in ("ras-pi-4", "workstation", "heavy"))
    assert [p.vehicle_kg for p in (pi, ground, heavy)] == pytest.approx([1.546, 1.5, 2.0])
    assert (ground.mass_g, ground.watts, heavy.mass_g, heavy.watts) == (0.0, 0.0, 500.0, 15.0)
    # As quick as the workstation to 0.3 %, and slower: it lowers its own roof.
    assert heavy.roof_m_s < 0.99 * ground.roof_m_s
    assert heavy.measured_m_s < ground.measured_m_s
    assert heavy.power_w > ground.power_w + 15.0 + 60.0
    # By the pack of the profile, 5.2 Ah at the mean of 4.2 and 3.5 V a cell.
    pack_j = 5.2 * 3600.0 * 4 * 3.85
    flight_j = heavy.power_w * MISSION_M / heavy.measured_m_s
    assert heavy.missions_per_charge == pytest.approx(pack_j / flight_j, rel=1e-6)


@pytest.mark.nightly
def test_what_flies_is_what_was_measured_and_not_the_closed_form(found: Roofline) -> None:
    for point in found.points:
        assert point.measured_m_s <= point.flown_m_s < 1.15 * point.measured_m_s
        assert point.f1_m_s > 1.15 * point.flown_m_s


def test_the_knee_and_what_binds(found: Roofline) -> None:
    pi, ground = of(found, "ras-pi-4"), of(found, "workstation")

    def short(hz: float) -> float:
        wanted = found.knee_share * ground.roof_m_s
        return ground.braking.safe_velocity(1.0 / hz, ground.room_m) - wanted

    assert ground.knee_hz == pytest.approx(brentq(short, 0.1, 1000.0), rel=1e-3)
    assert (pi.binds, ground.binds) == ("computer", "hold")
    assert pi.shares.computer == pytest.approx(2 * 0.4615, abs=2e-3)


def test_a_computer_that_was_never_timed_is_left_out_and_said_so(
    found: Roofline, shown: tuple[Path, str], tmp_path: Path
) -> None:
    (left,) = found.left_out
    assert left.computer.endswith("untimed.toml")
    assert "left out: no workload template-5x32 measured (measured: none)" in shown[1]
    refusals: tuple[tuple[dict[str, Any], str], ...] = (
        ({"computers": (left.computer,)}, "no workload template-5x32 measured"),
        ({"workload": "policy"}, "no latency measured for static-obstacles-fast "),
        ({"workload": "estimate"}, "workload 'estimate': accepted: a measured workload, or policy"),
        ({"policy": "greedy", "sensing_distance_m": None}, "policy greedy is no network"),
        ({"computers": ("ras-pi-4", "ras-pi-4")}, "each once"),
    )
    for asked, told in refusals:
        with pytest.raises(UsageError) as refused:
            knobs = {"sensing_distance_m": SENSED_M, "draws": 1, **asked}
            roofline(RooflineRequest(**knobs), out=tmp_path / "none")
        assert told in str(refused.value)
    assert not (tmp_path / "none").exists()


def test_the_page_stands_alone(shown: tuple[Path, str]) -> None:
    folder, terminal = shown
    page = (folder / "roofline.html").read_text(encoding="utf-8")
    assert "data:image/svg+xml;base64," in page
    assert 'src="http' not in page and 'href="http' not in page
    assert (folder / "roofline.png").read_bytes()[:4] == b"\x89PNG"
    for text in ("Safe velocity", "Reaction time", "heavy", "computer: its inference"):
        assert text in page
        assert text in terminal
    held = json.loads((folder / "roofline.json").read_text(encoding="utf-8"))
    assert [each["computer"] for each in held["points"]] == ["ras-pi-4", "workstation", "heavy"]


# --- taking notice


class StopsBefore(Runtime):
    """Network that turns away from objects nearer than a depth, above the horizon."""

    def __init__(self, depth_m: float) -> None:
        self._byte = depth_m / CARD.observation.range_m * 255.0

    def infer(self, encoded: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        upper = encoded["depth"][:, 0, : CARD.observation.height_px // 2]  # no floor in it
        near = upper.min(axis=(1, 2)) < self._byte
        scores = np.zeros((len(near), 25), np.float32)
        scores[np.arange(len(near)), np.where(near, 20, 22)] = 1.0
        return scores


def test_a_policy_takes_notice_at_the_depth_at_which_it_acts() -> None:
    for depth_m in (3.0, 9.5):
        depths = noticed_m(LearnedPolicy(CARD, StopsBefore(depth_m)), QUAD)
        assert depths.shape == (75,)
        # To a step of the depths, 0.2 m, and a byte of the image, 0.08 m.
        assert depths == pytest.approx(depth_m, abs=0.28)
    assert not noticed_m(LearnedPolicy(CARD, StopsBefore(0.0)), QUAD).any()


@pytest.mark.nightly
def test_the_sensing_distance_is_the_least_that_the_policy_took_notice_at(tmp_path: Path) -> None:
    asked: dict[str, Any] = {"policy": "static-obstacles", "computers": ("workstation",)}
    result = roofline(**asked, draws=1, out=tmp_path / "out")
    assert result.found.sensing_distance_m == min(result.found.noticed_m)
    assert 4.0 < result.found.sensing_distance_m < 12.0
