"""Fuzz test of recordings and meshes, read by the commands.

    python scripts/fuzz_recordings.py --seconds 600

A vehicle's log, a black box and a run folder, flown once at the start, and meshes in every format
are damaged in their bytes, most often in the headers near the beginning. `airl identify`, `airl
report`, `airl export-log` and `airl asset` must accept each, or reject it with one line. The test
stops at the first other result, keeps the file, and prints the case, which `--what WHAT --first
NUMBER` repeats.
"""

from __future__ import annotations

import io
import resource
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
import tyro
from fuzz_inputs import damaged

from airl_mav.cli.main import subcommands
from airl_mav.cli.options import carry_out
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from tests.support.recorded_flights import fly_recorded

SEED = 3
"""Seed of the recorded flight."""

HEADER_BYTES = 4_000
"""Approximate size of a recording's header: its formats and first records."""

MOST_BYTES = 8 << 30
"""Maximum address space for reading a damaged file; exceeding it means that a damaged size was
used."""

WORDS = (b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\xc0\x7f", b"\0\0\x80\x7f")
"""Replacement numbers for lengths and positions: maximum, zero, NaN, infinity."""

MESH_FORMATS = ("stl", "obj", "glb", "ply", "off")
TEXT_FORMATS = ("obj", "off", "json", "jsonl", "toml")
READ_OF_A_RUN = (".json", ".jsonl", ".toml", ".npz")


def damaged_bytes(rng: np.random.Generator, whole: bytes) -> bytes:
    """Return bytes with one to five defects, in over half of the cases all near the beginning."""
    end = HEADER_BYTES if rng.random() < 0.6 else len(whole)
    raw, rest = bytearray(whole[:end]), whole[end:]
    for _ in range(1 + int(rng.integers(5))):
        at = int(rng.integers(len(raw) + 1))
        kind = int(rng.integers(6))
        if kind == 0:
            raw[at : at + 1] = bytes([int(rng.integers(256))])
        elif kind == 1:
            raw = raw[:at]
        elif kind == 2:
            raw[at:at] = rng.bytes(int(rng.integers(1, 20)))
        elif kind == 3:
            del raw[at : at + int(rng.integers(1, 50))]
        elif kind == 4:
            raw[at : at + 4] = WORDS[int(rng.integers(len(WORDS)))]
        else:
            other = int(rng.integers(len(raw) + 1))
            raw[at : at + 30] = raw[other : other + 30]
    return bytes(raw) + rest


def damaged_file(rng: np.random.Generator, path: Path) -> bytes:
    """Return the damaged content of a file; text may be damaged by lines."""
    whole = path.read_bytes()
    if path.suffix[1:] in TEXT_FORMATS and rng.random() < 0.5:
        return damaged(rng, whole)
    return damaged_bytes(rng, whole)


@cache
def _folder() -> Path:
    """Return the folder of damaged files, which lives as long as this process."""
    held = tempfile.TemporaryDirectory(prefix="fuzz-recordings-")
    _HELD.append(held)
    return Path(held.name)


_HELD: list[tempfile.TemporaryDirectory[str]] = []


@cache
def _flown() -> tuple[Path, Path]:
    """Return a black box and the vehicle's log of a flight."""
    asked = Scenario(policy="static-obstacles", level="lockstep", latency="50ms")
    flight = fly_recorded(resolve(asked), SEED, _folder() / "flight")
    return flight.black_box, flight.ulg


@cache
def _run() -> Path:
    """Return the folder of a run."""
    run = _folder() / "run"
    words = ["no-obstacles", "--episodes", "2", "--level", "lockstep", "--out", str(run)]
    with redirect_stdout(io.StringIO()):
        carry_out("airl evaluate", "airl_mav.cli.evaluate_command", words)
    return run


@cache
def _mesh(kind: str) -> Path:
    """Return a mesh in a format."""
    path = _folder() / f"mesh.{kind}"
    trimesh.creation.icosphere(subdivisions=1).export(path)
    return path


def _damaged_copy(rng: np.random.Generator, source: Path, folder: Path) -> Path:
    path = folder / source.name
    path.write_bytes(damaged_file(rng, source))
    return path


def _log(rng: np.random.Generator, folder: Path) -> tuple[str, list[str]]:
    log = _damaged_copy(rng, _flown()[1], folder)
    return "identify", [str(log), "--vehicle", "quad", "--out", str(folder / "out")]


def _black_box(rng: np.random.Generator, folder: Path) -> tuple[str, list[str]]:
    box = _damaged_copy(rng, _flown()[0], folder)
    command = ("identify", "report", "export_log")[int(rng.integers(3))]
    return command, [str(box), *(() if command == "report" else ("--out", str(folder / "out")))]


def _run_folder(rng: np.random.Generator, folder: Path) -> tuple[str, list[str]]:
    run = folder / "run"
    shutil.copytree(_run(), run)
    files = sorted(path for path in run.iterdir() if path.suffix in READ_OF_A_RUN)
    path = files[int(rng.integers(len(files)))]
    path.write_bytes(damaged_file(rng, path))
    if rng.random() < 0.1:
        path.unlink()
    if rng.random() < 0.5:
        return "report", [str(run)]
    return "export_log", [str(run), "--out", str(folder / "out")]


def _mesh_file(rng: np.random.Generator, folder: Path) -> tuple[str, list[str]]:
    kind = MESH_FORMATS[int(rng.integers(len(MESH_FORMATS)))]
    mesh = _damaged_copy(rng, _mesh(kind), folder)
    return "asset", [str(mesh), "--out", str(folder / "out.toml")]


CASES: Mapping[str, Callable[[np.random.Generator, Path], tuple[str, list[str]]]] = {
    "log": _log,
    "black-box": _black_box,
    "run": _run_folder,
    "mesh": _mesh_file,
}
"""Damaged inputs, each with the command that reads it."""


def read_damaged(what: str, number: int) -> str:
    """Damage an input, and read it with its command; return the result.

    Raises:
        Exception: The input was neither accepted nor rejected with one line.
    """
    rng = np.random.default_rng((number, list(CASES).index(what)))
    folder = Path(tempfile.mkdtemp(prefix="fuzz-case-"))
    command, words = CASES[what](rng, folder)
    said = io.StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said):
            code = carry_out("airl", subcommands()[command.replace("_", "-")][2], words)
        assert code == 0, f"exit status {code}"
    except UsageError as error:
        assert str(error).strip(), "refused without a word"
        assert "\n" not in str(error), f"more than one line: {error}"
        shutil.rmtree(folder)
        return f"{command} refused"
    except BaseException:
        print(f"airl {command} {' '.join(words)}\n{said.getvalue()}")
        raise
    assert "Traceback" not in said.getvalue(), said.getvalue()
    shutil.rmtree(folder)
    return f"{command} taken"


@dataclass(frozen=True)
class Fuzz:
    """Give damaged recordings and meshes to the commands that read them."""

    seconds: float = 60.0
    """Duration of each kind of test [wall s]."""
    what: tuple[str, ...] = tuple(CASES)
    """Kinds of test."""
    first: int = 0
    """First case; its number is its seed."""


def main(asked: Fuzz) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    for what in asked.what:
        clock, number = WallClock(), asked.first
        came: Counter[str] = Counter()
        while clock.time_us() < asked.seconds * US_PER_S:
            try:
                came[read_damaged(what, number)] += 1
            except BaseException:
                print(f"{what} {number} broke: --what {what} --first {number}")
                raise
            number += 1
        print(f"{what}: {number - asked.first} cases: {dict(sorted(came.items()))}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Fuzz, description=__doc__))
