from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from airl_mav.core.errors import UsageError
from airl_mav.core.files import add_arrays, close_archive, json_line, read_groups, replace_file
from airl_mav.core.machine import git_state
from airl_mav.flight.trajectory import Trajectory
from airl_mav.rehearsal.run_folder import (
    EPISODES_FILE,
    LATENCY_FILE,
    TRAJECTORIES_FILE,
    FlownEpisode,
    RunFolder,
    load,
)
from tests.support.run_demo import demo_arena, demo_episode, demo_setup, write_demo_run


def same_path(a: Trajectory, b: Trajectory) -> bool:
    ours, theirs = a.arrays(), b.arrays()
    return all(np.array_equal(ours[name], theirs[name]) for name in ours)


def test_a_run_reads_back_as_it_was_written(tmp_path: Path) -> None:
    folder, arenas = write_demo_run(tmp_path / "run", episodes=3)
    run = load(folder.path)
    assert [episode.index for episode in run.episodes] == [0, 1, 2]
    for index, arena in arenas.items():
        record, trajectory, latency = demo_episode(index, arena)
        assert run.episodes[index] == record
        assert same_path(run.trajectories[index], trajectory)
        assert set(run.latency[index]) == set(latency)
        for name, values in latency.items():
            assert np.array_equal(run.latency[index][name], values)
            assert run.latency[index][name].dtype == values.dtype
    assert run.info.seeds == (7, 8, 9)
    assert run.info.config["companion"] == {"hold_s": 0.5}
    assert run.info.setup == demo_setup()


def test_run_json_says_what_it_was_made_with(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", "r", {"model": tmp_path}, setup=demo_setup())
    data = json.loads((folder.path / "run.json").read_text())
    assert data["schema"] == 1
    assert data["versions"]["numpy"] == np.__version__
    assert data["machine"]["cores"] == os.cpu_count()
    assert data["machine"]["python"].endswith("{}.{}.{}".format(*sys.version_info[:3]))
    assert data["config"] == {"model": str(tmp_path)}


def test_the_default_folder_has_time_and_name_and_is_never_reused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    paths = [RunFolder.create(None, "demo", {}, setup=demo_setup()).path for _ in range(3)]
    assert len(set(paths)) == 3
    for path in paths:
        assert path.parent == Path("runs")
        stamp, name = path.name.split("-")[:2]
        assert len(stamp) == len("20261120T120000Z")
        assert name == "demo"


def test_a_folder_with_a_run_or_a_file_is_refused(tmp_path: Path) -> None:
    RunFolder.create(tmp_path / "run", "a", {}, setup=demo_setup())
    with pytest.raises(UsageError, match="already holds a run"):
        RunFolder.create(tmp_path / "run", "b", {}, setup=demo_setup())
    (tmp_path / "file").write_text("x")
    with pytest.raises(UsageError, match="--out"):
        RunFolder.create(tmp_path / "file", "c", {}, setup=demo_setup())


def test_tlogs_have_a_name_each(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    assert folder.tlog_path(7) == tmp_path / "flight-007.tlog"
    assert folder.tlog_path(1234) == tmp_path / "flight-1234.tlog"


def test_a_line_cut_short_is_passed_over_and_cut_off(tmp_path: Path) -> None:
    folder, _ = write_demo_run(tmp_path / "run", episodes=2)
    lines = folder.path / EPISODES_FILE
    whole = lines.read_bytes()
    record, trajectory, latency = demo_episode(2, demo_arena(3))
    line = json_line(record.as_data())
    for cut in (1, 40, len(line) - 1):
        lines.write_bytes(whole + line[:cut])
        assert [episode.index for episode in load(folder.path).episodes] == [0, 1]
        resumed, run = RunFolder.resume(folder.path)
        assert len(run.episodes) == 2
        assert lines.read_bytes() == whole
    resumed.save_episodes([FlownEpisode(record, trajectory, latency)])
    assert [episode.index for episode in load(folder.path).episodes] == [0, 1, 2]


def test_a_broken_line_in_the_middle_names_its_place(tmp_path: Path) -> None:
    folder, _ = write_demo_run(tmp_path / "run", episodes=2)
    lines = folder.path / EPISODES_FILE
    first, second = lines.read_text().splitlines()
    lines.write_text(f"{first[:30]}\n{second}\n")
    with pytest.raises(UsageError, match=r"episodes\.jsonl:1: not JSON"):
        load(folder.path)


def test_an_episode_without_its_line_never_happened_and_can_be_flown_again(tmp_path: Path) -> None:
    folder, _ = write_demo_run(tmp_path / "run", episodes=2)
    lines = folder.path / EPISODES_FILE
    lines.write_text(lines.read_text().splitlines()[0] + "\n")
    run = load(folder.path)
    assert set(run.trajectories) == set(run.latency) == {0}
    other = demo_episode(5, demo_arena(6))
    again = (replace(other[0], index=1), other[1], {"sent_us": np.arange(3)})
    RunFolder.resume(folder.path)[0].save_episodes([FlownEpisode(*again)])
    run = load(folder.path)
    assert same_path(run.trajectories[1], other[1])
    assert list(run.latency[1]) == ["sent_us"]
    assert "capture_us" in run.latency[0]


def test_a_run_before_its_first_episode_reads_back_empty(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", "a", {}, setup=demo_setup())
    run = load(folder.path)
    assert (run.episodes, run.latency, run.trajectories) == ((), {}, {})


def test_no_run_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no run here: run\.json"):
        load(tmp_path)
    folder, _ = write_demo_run(tmp_path / "run", episodes=1)
    (folder.path / LATENCY_FILE).write_bytes(b"PK nonsense")
    with pytest.raises(UsageError, match=r"latency\.npz"):
        load(folder.path)
    (folder.path / "run.json").write_text('{"schema": 9}')
    with pytest.raises(UsageError, match="schema = 9: accepted: 1"):
        load(folder.path)


WRITER = """
import sys
from dataclasses import replace
from pathlib import Path
from tests.support.run_demo import demo_arena, demo_episode, demo_setup
from airl_mav.rehearsal.run_folder import FlownEpisode, RunFolder
path = Path(sys.argv[1])
if (path / "run.json").exists():
    folder, run = RunFolder.resume(path)
    start = len(run.episodes)
else:
    folder, start = RunFolder.create(path, "killed", {}, setup=demo_setup()), 0
record, trajectory, latency = demo_episode(0, demo_arena(1))
for index in range(start, 10_000):
    folder.save_episodes([FlownEpisode(replace(record, index=index), trajectory, latency)])
    print(index, flush=True)
"""


def test_kill_9_at_any_moment_loses_one_episode_at_most(tmp_path: Path) -> None:
    path = tmp_path / "run"
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = 0
    for extra in (3, 5, 2):
        with subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True, env=env
        ) as writer:
            assert writer.stdout is not None
            for _ in range(extra):
                said = int(writer.stdout.readline())
            writer.send_signal(signal.SIGKILL)
        run = load(path)
        indices = [episode.index for episode in run.episodes]
        assert indices == list(range(len(indices)))
        assert len(indices) >= said + 1 >= done + extra
        assert set(run.trajectories) == set(run.latency) == set(indices)
        done = len(indices)


def test_archives_are_the_same_bytes_for_the_same_arrays(tmp_path: Path) -> None:
    arrays: dict[str, np.ndarray] = {"x": np.arange(5), "y": np.ones((2, 3), np.float32)}
    groups = {"000", "001"}
    for name in ("a.npz", "b.npz"):
        path = tmp_path / name
        add_arrays(path, {"000": arrays})
        if name == "b.npz":
            close_archive(path, groups)  # is opened again
        add_arrays(path, {"001": arrays})
        close_archive(path, groups)
        before = path.read_bytes()
        close_archive(path, groups)
        assert path.read_bytes() == before
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz") as archive:
        assert archive.files == ["000/x", "000/y", "001/x", "001/y"]
        assert archive["001/y"].dtype == np.float32
        assert archive["001/x"].tolist() == list(range(5))


def test_an_archive_without_its_end_is_read_and_completed(tmp_path: Path) -> None:
    """A kill may leave any number of bytes: whole groups survive, and the next run is the same."""
    path = tmp_path / "a.npz"
    groups = {f"{i:03d}": {"x": np.arange(5 + i), "y": np.ones(i)} for i in range(3)}
    ends = []
    for name, arrays in groups.items():
        add_arrays(path, {name: arrays})
        ends.append(path.stat().st_size)
    appended = path.read_bytes()
    close_archive(path, groups)
    whole = path.read_bytes()
    assert whole.startswith(appended)
    edges = [end + shift for end in ends for shift in (-1, 0, 1)]
    for cut in sorted({*edges, *range(0, len(whole), 61)}):
        path.write_bytes(whole[:cut])
        kept = [name for name, end in zip(groups, ends, strict=True) if end <= cut]
        found = read_groups(path, kept)
        assert list(found) == kept
        assert all(found[each].arrays["x"].size == 5 + int(each) for each in kept)
        close_archive(path, kept)
        with np.load(path) as archive:
            assert archive.files == [f"{name}/{array}" for name in kept for array in "xy"]
        for name in list(groups)[len(kept) :]:
            add_arrays(path, {name: groups[name]})
        close_archive(path, groups)
        assert path.read_bytes() == whole


def test_groups_in_the_middle_of_an_archive_are_removed(tmp_path: Path) -> None:
    path, other = tmp_path / "a.npz", tmp_path / "b.npz"
    for name in ("000", "001", "002"):
        add_arrays(path, {name: {"x": np.arange(5) + int(name)}})
        if name != "001":
            add_arrays(other, {name: {"x": np.arange(5) + int(name)}})
    close_archive(path, {"000", "002"})
    close_archive(other, {"000", "002"})
    assert path.read_bytes() == other.read_bytes()
    with np.load(path) as archive:
        assert archive.files == ["000/x", "002/x"]
        assert archive["002/x"].tolist() == [2, 3, 4, 5, 6]


def bytes_written() -> int:
    """Return the bytes that this process has passed to write calls."""
    fields = Path("/proc/self/io").read_text().splitlines()
    return int(dict(field.split(": ") for field in fields)["wchar"])


def test_saving_a_run_writes_its_archives_once(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", "many", {}, setup=demo_setup())
    record, trajectory, latency = demo_episode(0, demo_arena(1))
    before = bytes_written()
    for index in range(100):
        folder.save_episodes([FlownEpisode(replace(record, index=index), trajectory, latency)])
    folder.close()
    written = bytes_written() - before
    archives = (TRAJECTORIES_FILE, LATENCY_FILE)
    size = sum((folder.path / name).stat().st_size for name in (*archives, EPISODES_FILE))
    assert size <= written < 1.05 * size
    for name in archives:
        with np.load(folder.path / name) as archive:
            assert len({key.partition("/")[0] for key in archive.files}) == 100


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    add_arrays(path, {"000": {"x": np.arange(5)}})
    before = path.read_bytes()
    with pytest.raises(ValueError, match="Object arrays"):
        add_arrays(path, {"001": {"x": np.arange(3), "bad": np.array([object()])}})
    assert path.read_bytes() == before
    replace_file(path, b"new")
    assert path.read_bytes() == b"new"


def test_the_commit_of_a_checkout(tmp_path: Path) -> None:
    assert git_state(tmp_path) is None

    def git(*words: str) -> str:
        command = ["git", "-C", str(tmp_path), "-c", "user.name=n", "-c", "user.email=e@x", *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "--quiet")
    assert git_state(tmp_path) is None
    (tmp_path / "f").write_text("1")
    git("add", "f")
    git("commit", "--quiet", "-m", "one")
    commit = git("rev-parse", "HEAD")
    assert git_state(tmp_path) == {"commit": commit, "changed": False}
    (tmp_path / "f").write_text("2")
    assert git_state(tmp_path) == {"commit": commit, "changed": True}


def test_the_example_in_the_documentation_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = Path(__file__).parents[2] / "docs" / "reference" / "run-folder.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    (folder,) = re.findall(r'load_run\("(.*?)"\)', code)
    monkeypatch.chdir(tmp_path)
    write_demo_run(tmp_path / folder, episodes=2)
    exec(compile(code, page.name, "exec"), {})  # noqa: S102 - our own page
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("Estimate(value=0.5,")
    assert line.endswith(" ms")


def test_the_documentation_names_every_field(tmp_path: Path) -> None:
    page = Path(__file__).parents[2] / "docs" / "reference" / "run-folder.md"
    text = page.read_text(encoding="utf-8")
    folder, _ = write_demo_run(tmp_path / "run", episodes=1)
    info = json.loads((folder.path / "run.json").read_text())
    line = json.loads((folder.path / EPISODES_FILE).read_text())
    run = load(folder.path)
    names = {
        *info,
        *info["setup"],
        *info["setup"]["injection"],
        *info["machine"],
        *line,
        *line["quality"],
        *line["companion_use"],
        *run.latency[0],
    }
    names |= set(run.trajectories[0].arrays())
    names -= {"setup", "injection"}  # Described part by part.
    assert not [name for name in names if f"{name}`" not in text]
