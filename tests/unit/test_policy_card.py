"""Policy card: belongs to a single file and describes its inputs and outputs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("sb3_contrib", reason="needs the [train] extra")
pytest.importorskip("onnxscript", reason="needs the [train] extra")

import onnx

from airl_mav.core.errors import UsageError
from airl_mav.policy.card import (
    MeasuredResult,
    PolicyCard,
    Training,
    digest,
    load_card,
    read_card,
    vehicle_mismatch,
)
from airl_mav.policy.card_writing import write_card
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.vehicle import load_vehicle
from tests.support.policy_kit import SPEC, export_tiny, facts


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policy") / "tiny"
    export_tiny(folder, with_torch=True)
    return folder


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A policy that a test may spoil."""
    return Path(shutil.copytree(original, tmp_path / "tiny"))


def refusal(folder: Path, load: Callable[[Path], Any] = load_card) -> str:
    with pytest.raises(UsageError) as error:
        load(folder)
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value)
    return str(error.value)


def edit(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    plain = json.loads((folder / "card.json").read_text())
    change(plain)
    plain.pop("crc32", None)
    (folder / "card.json").write_text(json.dumps(plain))


def rebuild(folder: Path, change: Callable[[Any], Any]) -> None:
    """Change the network, and let the card vouch for it."""
    model = onnx.load(folder / "policy.onnx")
    change(model.graph)
    data = model.SerializeToString()
    (folder / "policy.onnx").write_bytes(data)
    edit(folder, lambda card: card.update(sha256=digest(data)))


def test_what_is_written_is_read(folder: Path) -> None:
    card = read_card(folder)
    config = {"steps": 3, "layers": [1, 2], "network": {"kind": "small", "scale": 0.5}}
    rich = card.model_copy(
        update={
            "results": (
                MeasuredResult(
                    arena="no-obstacles", level="gym", episodes=100, seed=7, success_rate=0.0
                ),
                MeasuredResult(
                    arena="static-obstacles",
                    level="sitl",
                    episodes=20,
                    seed=1,
                    success_rate=0.85,
                    flight_time_s=12.5,
                    distance_m=33.0,
                    energy_j=5100.0,
                ),
            ),
            "training": Training(
                arena="static-obstacles",
                first_arena_seed=0,
                last_arena_seed=9_999,
                seed=3,
                env_steps=1_000_000,
                config_file="static.toml",
                config=config,
                command="airl train static",
                versions={"torch": "2.13.0"},
                date_utc="2026-01-01T00:00:00+00:00",
            ),
        }
    )
    write_card(folder, rich)
    assert load_card(folder) == rich
    assert not list(folder.glob("*.partial"))


@pytest.mark.parametrize("file", ["policy.onnx", "policy.pt2"])
@pytest.mark.parametrize("where", [0, 1000, -1])
def test_one_wrong_bit_is_refused(folder: Path, file: str, where: int) -> None:
    data = bytearray((folder / file).read_bytes())
    data[where] ^= 1
    (folder / file).write_bytes(data)
    load = load_card if file == "policy.onnx" else lambda f: write_card(f, read_card(f))
    message = refusal(folder, load)
    assert f"{file}: SHA-256 {digest(bytes(data))[:12]}" in message
    assert "that of card.json" in message


def test_missing_and_cut_files_are_refused(folder: Path) -> None:
    data = (folder / "policy.onnx").read_bytes()
    (folder / "policy.onnx").write_bytes(data[:-1])
    assert "policy.onnx: SHA-256" in refusal(folder)
    (folder / "policy.onnx").unlink()
    assert "policy.onnx: No such file" in refusal(folder)
    (folder / "card.json").unlink()
    assert "card.json: No such file" in refusal(folder)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "not JSON"),
        ("{", "not JSON"),
        ("\xff\xfe", "not JSON"),
        ("[]", "schema = None: accepted: 1"),
        ("3", "schema = None: accepted: 1"),
        ("{}", "schema = None: accepted: 1"),
        ('{"schema": 2, "new": 1}', "schema = 2: accepted: 1"),
        ('{"schema": 1}', "missing"),
    ],
)
def test_a_card_that_is_none_is_refused(folder: Path, text: str, word: str) -> None:
    (folder / "card.json").write_bytes(text.encode("latin-1"))
    assert word in refusal(folder)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"hold_s": 11.0}, ["hold_s = 11", "0 <= value <= 10 s"]),
        ({"hold_s": "0.5"}, ["hold_s = '0.5'", "0 <= value <= 10 s"]),
        ({"hold_s": float("nan")}, ["not JSON: NaN is no JSON"]),
        ({"altitude_m": 0.0}, ["altitude_m = 0", "0.5 <= value <= 100 m"]),
        ({"goal_radius_m": True}, ["goal_radius_m = True", "0.2 <= value <= 50 m"]),
        ({"epsilon": -0.1}, ["epsilon = -0.1", "0 <= value <= 1"]),
        ({"macs": 0}, ["macs = 0", "1 <= value"]),
        ({"parameters": 1.5}, ["parameters = 1.5", "1 <= value"]),
        ({"name": "../up"}, ["name = '../up'"]),
        ({"name": ""}, ["name = ''"]),
        ({"sha256": "abc"}, ["sha256 = 'abc'"]),
        ({"holds": 0.5}, ["holds: unknown field", "hold_s"]),
        ({"actions": {"set": "fly"}}, ["actions.set = 'fly'", "arc-25"]),
        ({"actions": {"max_speed_m_s": 31.0}}, ["actions.max_speed_m_s = 31", "<= 30 m/s"]),
        (
            {"actions": {"set": "velocity"}, "epsilon": 0.1},
            ["epsilon = 0.1: accepted: 0 with the action set 'velocity'"],
        ),
        ({"results": [{"arena": "a", "level": "gym"}]}, ["results.0.", "missing"]),
        ({"training": {"env_steps": -1}}, ["training.env_steps = -1", "0 <= value"]),
    ],
    ids=str,
)
def test_a_wrong_field_is_named_with_its_range(
    folder: Path, change: dict[str, Any], words: list[str]
) -> None:
    edit(folder, lambda card: card.update(change))
    message = refusal(folder)
    assert "card.json: " in message
    for word in words:
        assert word in message


def test_a_missing_field_is_named(folder: Path) -> None:
    edit(folder, lambda card: card.pop("observation"))
    assert "observation: missing" in refusal(folder)


def set_axis(value: Any, axis: int, size: int) -> None:
    value.type.tensor_type.shape.dim[axis].dim_value = size


def one_row_only(graph: Any) -> None:
    for value in (*graph.input, *graph.output):
        set_axis(value, 0, 1)


def rename(graph: Any, old: str, new: str) -> None:
    for value in (*graph.input, *graph.output):
        value.name = new if value.name == old else value.name
    for node in graph.node:
        for names in (node.input, node.output):
            names[:] = [new if name == old else name for name in names]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda g: rename(g, "velocity", "speed"), ["inputs", "speed", "velocity tensor(float)"]),
        (lambda g: rename(g, "action", "q"), ["outputs q", "action tensor(float) (n, 25)"]),
        (
            one_row_only,
            ["depth tensor(uint8) (1, 1, 24, 32)", "depth tensor(uint8) (n, 1, 24, 32)"],
        ),
    ],
    ids=["another input", "another output", "one row only"],
)
def test_a_network_that_takes_or_gives_something_else_is_refused(
    folder: Path, change: Callable[[Any], Any], words: list[str]
) -> None:
    rebuild(folder, change)
    message = refusal(folder)
    assert "policy.onnx: " in message
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"actions": {"set": "velocity"}}, ["action tensor(float) (n, 25)", "(n, 2)"]),
        (
            {"observation": {**SPEC.model_dump(), "height_px": 48, "width_px": 64}},
            ["depth tensor(uint8) (n, 1, 24, 32)", "accepted: depth tensor(uint8) (n, 1, 48, 64)"],
        ),
    ],
    ids=["action set", "image"],
)
def test_a_card_that_says_something_else_than_the_network_is_refused(
    folder: Path, change: dict[str, Any], words: list[str]
) -> None:
    edit(folder, lambda card: card.update(change))
    message = refusal(folder)
    for word in words:
        assert word in message


def test_a_file_that_is_no_onnx_is_refused_though_the_digest_fits(folder: Path) -> None:
    for data in (b"", b"not a network", (folder / "policy.onnx").read_bytes()[:5000]):
        (folder / "policy.onnx").write_bytes(data)

        def record_digest(card: dict[str, Any], sha256: str = digest(data)) -> None:
            card["sha256"] = sha256

        edit(folder, record_digest)
        assert "not a model that ONNX Runtime loads" in refusal(folder)


def test_no_card_is_written_for_another_file(folder: Path, original: Path) -> None:
    card = read_card(folder)
    before = (folder / "card.json").read_bytes()
    wrong = card.model_copy(update={"sha256": "0" * 64, "description": "an impostor"})
    assert "policy.onnx: SHA-256" in refusal(folder, lambda f: write_card(f, wrong))
    assert (folder / "card.json").read_bytes() == before
    (folder / "policy.onnx").unlink()
    assert "No such file" in refusal(folder, lambda f: write_card(f, card))


def test_a_kill_between_policy_and_card_leaves_no_card_for_the_wrong_policy(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = read_card(folder)

    def killed(path: Path, data: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("airl_mav.core.files.write_json", killed)
    with pytest.raises(KeyboardInterrupt):
        export_tiny(folder, "PPO", name="other")
    monkeypatch.undo()
    assert read_card(folder) == old
    assert digest((folder / "policy.onnx").read_bytes()) != old.sha256
    assert "policy.onnx: SHA-256" in refusal(folder)


# --- the vehicle's camera


def camera(**changes: Any) -> Camera:
    return load_vehicle("quad").camera.model_copy(update=changes)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"width_px": 32, "height_px": 24},
        {"width_px": 320, "height_px": 240},
        {"range_m": 40.0},
        {"horizontal_fov_deg": 90.05},
    ],
    ids=str,
)
def test_cameras_that_fit(folder: Path, changes: dict[str, Any]) -> None:
    assert vehicle_mismatch(read_card(folder), camera(**changes)) is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"width_px": 48, "height_px": 36}, ["48x36", "32x24 px or a whole multiple"]),
        ({"width_px": 64, "height_px": 24}, ["64x24"]),
        ({"width_px": 16, "height_px": 12}, ["16x12"]),
        ({"horizontal_fov_deg": 87.0}, ["field of view of 87.0 deg", "accepted: 90.0 deg"]),
        ({"range_m": 10.0}, ["range of 10 m", "accepted: 20 m or more"]),
    ],
    ids=str,
)
def test_cameras_that_do_not_fit(folder: Path, changes: dict[str, Any], words: list[str]) -> None:
    reason = vehicle_mismatch(read_card(folder), camera(**changes))
    assert reason is not None
    for word in words:
        assert word in reason


def test_facts_and_card_share_their_fields() -> None:
    """The card adds the facts read from the file and keeps all facts of its author."""
    extra = set(PolicyCard.model_fields) - set(type(facts()).model_fields)
    assert extra == {
        *("sha256", "torch_sha256", "state", "network", "parameters", "macs", "quantisation")
    }
