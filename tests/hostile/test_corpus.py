"""Hostile files and folders, read by the commands: no code, no file outside, no traceback.

Nightly reads the whole corpus; every change reads a sample. `python -m tests.hostile.corpus` prints
the outcome of each entry: exit code, duration, peak memory and last line.
"""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("onnx", reason="needs the [train] extra")
pytest.importorskip("pyulog", reason="needs the [identify] extra")
pytest.importorskip("trimesh", reason="needs the [mesh] extra")

from tests.hostile.corpus import corpus
from tests.hostile.reading import Entry, preload, read

LEAST = 150

SAMPLE = {
    "run: run.json is zero",
    "run: episodes.jsonl is FIFO",
    "run: nested 100000 deep",
    "flight: goal = [1e+308, 1e+308]",
    "trajectories.npz: huge shape",
    "trajectories.npz: pickle",
    "export: flight-000.ulg is secret",
    "export: flight-000.ulg is FIFO",
    "export: escapes in texts",
    "policy: model is nested groups",
    "policy: torch program is a pickle",
    "export: pickled model",
    "arena: nested",
    "box: run with nested",
    "log: negative array",
    "mesh: gltf file outside",
    "mesh: ply count",
}
"""Entries of every change."""

ENTRIES = {entry.name: entry for entry in corpus()}


@pytest.fixture(scope="module", autouse=True)
def preloaded() -> None:
    preload()


@pytest.mark.parametrize(
    "entry",
    [
        pytest.param(each, id=name, marks=() if name in SAMPLE else pytest.mark.nightly)
        for name, each in ENTRIES.items()
    ],
)
@pytest.mark.timeout(300)
@pytest.mark.filterwarnings("ignore:.*fork")
def test_a_hostile_input_is_refused_in_one_line_or_read(entry: Entry, tmp_path: Path) -> None:
    result = read(entry, tmp_path)
    assert not result.problems, result.row()


def test_the_corpus_is_large() -> None:
    assert len(ENTRIES) == len(corpus()) >= LEAST
    assert ENTRIES.keys() >= SAMPLE
