"""Files: writes are atomic, and damaged files are detected."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import zlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

from airl_mav.core import files
from airl_mav.core.errors import UsageError
from airl_mav.core.files import (
    add_arrays,
    append_lines,
    read_groups,
    read_json,
    read_lines,
    write_json,
)
from airl_mav.flight.trajectory import Trajectory
from airl_mav.rehearsal.run_folder import (
    EPISODES_FILE,
    LATENCY_FILE,
    RUN_FILE,
    TRAJECTORIES_FILE,
    LoadedRun,
    load,
)
from tests.support.run_demo import write_demo_run

FLIPS = 300
OLD_RUN = Path(__file__).parents[1] / "support" / "run_without_checksums"
"""Two episodes of a lockstep run, thinned out, as they were written before files had checksums."""

Arrays = Mapping[str, np.ndarray]


def same_arrays(ours: Arrays, theirs: Arrays) -> bool:
    return ours.keys() == theirs.keys() and all(
        ours[name].dtype == theirs[name].dtype and np.array_equal(ours[name], theirs[name])
        for name in ours
    )


def same_run(ours: LoadedRun, theirs: LoadedRun) -> bool:
    def paths(run: LoadedRun) -> dict[int, Arrays]:
        return {index: path.arrays() for index, path in run.trajectories.items()}

    return (
        asdict(ours.info) == asdict(theirs.info)
        and ours.episodes == theirs.episodes
        and all(
            a.keys() == b.keys() and all(same_arrays(a[i], b[i]) for i in a)
            for a, b in ((ours.latency, theirs.latency), (paths(ours), paths(theirs)))
        )
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, _ = write_demo_run(tmp_path_factory.mktemp("flips") / "run", episodes=3)
    return folder.path


@pytest.mark.parametrize("name", [RUN_FILE, EPISODES_FILE, LATENCY_FILE, TRAJECTORIES_FILE])
def test_no_flipped_bit_is_read_as_another_run(run: Path, tmp_path: Path, name: str) -> None:
    whole = load(run)
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    data = (run / name).read_bytes()
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    refused = 0
    # The last bytes too: a newline, the end of an archive's directory.
    positions = [*rng.integers(0, len(data), FLIPS - 30), *range(len(data) - 30, len(data))]
    for position in positions:
        flipped = bytearray(data)
        flipped[position] ^= 1 << int(rng.integers(8))
        (copy / name).write_bytes(flipped)
        try:
            found = load(copy)
        except UsageError as error:
            assert "\n" not in str(error)
            assert name in str(error) or name == RUN_FILE or EPISODES_FILE in str(error)
            refused += 1
        else:
            assert same_run(found, whole), f"byte {position} of {name} was changed in silence"
    assert refused > FLIPS // 2


@pytest.mark.parametrize("name", [EPISODES_FILE, LATENCY_FILE, TRAJECTORIES_FILE])
def test_a_file_cut_short_emptied_or_of_another_run_is_refused(
    run: Path, tmp_path: Path, name: str
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    data = (run / name).read_bytes()
    if name != EPISODES_FILE:  # That one may end anywhere: a kill cuts it short.
        for short in (b"", data[: data.index(b"PK\1\2") - 1], data[: len(data) // 2]):
            (copy / name).write_bytes(short)
            with pytest.raises(UsageError, match=name):
                load(copy)
        (copy / name).unlink()
        with pytest.raises(UsageError, match=f"{name}: arrays of episode 0"):
            load(copy)
    other, _ = write_demo_run(tmp_path / "other", episodes=4, profile="no-obstacles")
    shutil.copy(other.path / name, copy / name)
    with pytest.raises(UsageError, match="arrays of episode"):
        load(copy)


def test_a_run_of_an_earlier_version_is_read(tmp_path: Path) -> None:
    old = load(OLD_RUN)
    assert [episode.index for episode in old.episodes] == [0, 1]
    assert set(old.latency) == set(old.trajectories) == {0, 1}
    assert isinstance(old.trajectories[0], Trajectory)
    assert len(old.trajectories[0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 100_000, "nested too deep"),
        ('{"schema": 1, "config": ' + "[" * 200 + "]" * 200 + "}", "nested too deep"),
        ('{"schema": 1, "seed": ' + "9" * 6000 + "}", "not JSON"),
        ('{"schema": 1, "seed": NaN}', "not JSON: NaN"),
        ("null", "schema = None"),
        ("[1]", "schema = None"),
        ('{"schema": 2}', "schema = 2: accepted: 1"),
        ('{"schema": 1, "crc32": 5}', "damaged: crc32 = 5"),
        ("\xff", "not JSON"),
    ],
    ids=lambda value: value[:20],
)
def test_what_is_no_object_of_ours_gets_one_line(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(UsageError) as caught:
        read_json(path, 1, "thing")
    assert f"{path}: " in str(caught.value)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_checksums_can_be_worked_out_without_this_package(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    write_json(path, {"schema": 1, "name": "größer", "pair": (1, 2.5), "none": None})
    data = json.loads(path.read_text(encoding="utf-8"))
    crc = data.pop("crc32")
    assert crc == f"{zlib.crc32(json.dumps(data, separators=(',', ':')).encode()):08x}"
    assert read_json(path, 1, "thing") == data
    path.write_text(path.read_text(encoding="utf-8").replace("größer", "kleiner"), "utf-8")
    with pytest.raises(UsageError, match="damaged: crc32"):
        read_json(path, 1, "thing")


FULL = """
import resource, sys
from pathlib import Path
import numpy as np
from airl_mav.core.files import add_arrays, append_lines, replace_file, save_arrays, write_json
folder, job = Path(sys.argv[1]), sys.argv[2]
noise = np.random.default_rng(0).random(5000)
jobs = {
    "replace": lambda: replace_file(folder / "x", bytes(50_000)),
    "json": lambda: write_json(folder / "x", {"schema": 1, "text": "x" * 50_000}),
    "arrays": lambda: save_arrays(folder / "x", {"x": noise}),
    "add": lambda: add_arrays(folder / "x", {"001": {"x": noise}}),
    "lines": lambda: append_lines(folder / "x", [{"text": "x" * 50_000}]),
}
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
try:
    jobs[job]()
except OSError as error:
    from airl_mav.core.errors import machine_failure
    print(machine_failure(error))
"""


@pytest.mark.parametrize("job", ["replace", "json", "arrays", "add", "lines"])
def test_a_write_that_fails_leaves_what_was_there(tmp_path: Path, job: str) -> None:
    """A limit on the size of files stands for a full disk: the same calls fail in the same way."""
    path = tmp_path / "x"
    if job == "add":
        add_arrays(path, {"000": {"x": np.arange(3)}})
    else:
        append_lines(path, [{"a": 1}])
    before = path.read_bytes()
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path), job], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"{path}: File too large\n"
    assert [each.name for each in tmp_path.iterdir()] == ["x"]
    assert path.read_bytes() == before
    assert read_groups(path, {"000"}) if job == "add" else read_lines(path, None)


def test_a_temporary_file_is_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    victim = tmp_path / "victim"
    victim.write_bytes(b"mine")
    monkeypatch.setattr("secrets.token_hex", lambda _: "00")
    (tmp_path / f"x.00{files.TEMPORARY_SUFFIX}").symlink_to(victim)
    with pytest.raises(FileExistsError):
        files.replace_file(tmp_path / "x", b"theirs")
    assert victim.read_bytes() == b"mine"
    assert not (tmp_path / "x").exists()


def test_an_error_while_writing_is_raised_and_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"old")
    with pytest.raises(ValueError, match="mine"), files.replacing(path) as partial:
        partial.write_bytes(b"new")
        raise ValueError("mine")
    assert [each.name for each in tmp_path.iterdir()] == ["x"]
    assert path.read_bytes() == b"old"


def test_errors_without_a_name_get_one() -> None:
    for error, name in (
        (OSError(28, "full"), "there"),
        (OSError(28, "full", "here"), "here"),
        (OSError("no number"), None),
    ):
        with pytest.raises(OSError, match=r".") as caught, files.naming(Path("there")):
            raise error
        assert caught.value.filename == name


def test_where_locks_are_unsupported_nothing_is_locked(tmp_path: Path) -> None:
    with (tmp_path / "x").open("wb") as file:
        assert files.try_lock(file.fileno())
        with (tmp_path / "x").open("rb") as other:
            assert not files.try_lock(other.fileno())
            closed = other.fileno()
    assert files.try_lock(closed), "any other error"


def test_a_wrong_field_is_one_line_with_its_source() -> None:
    adapter = TypeAdapter(dict[str, int])
    assert files.typed(adapter, {"a": 1}, "x.json") == {"a": 1}
    with pytest.raises(UsageError, match=r"^x\.json: "):
        files.typed(adapter, {"a": "b"}, "x.json")
