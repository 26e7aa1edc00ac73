"""Links in a run folder from an untrusted source: no file outside of the folder is written."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from airl_mav.addons.data_export import export_data
from airl_mav.addons.export_log import command as export_log
from airl_mav.addons.recordings import recorded_flight
from airl_mav.black_box import mcap_file
from airl_mav.cli import report_command
from airl_mav.cli.options import carry_out
from airl_mav.core import files
from airl_mav.core.child_process import ChildProcess
from airl_mav.core.errors import UsageError
from airl_mav.core.signing import write_key
from airl_mav.experiments import campaign
from airl_mav.rehearsal.run_folder import EPISODES_FILE, RunFolder, load
from airl_mav.training.training_folder import TrainingFolder
from tests.support.run_demo import write_demo_run

CONTENT = b"a file of the user, with the beginning of a line"
QUIET = Console(quiet=True)

LINKS: dict[str, Callable[[Path, Path], None]] = {
    "symbolic": lambda path, victim: path.symlink_to(victim),
    "hard": lambda path, victim: path.hardlink_to(victim),
}

REFUSED = "a link, or no regular file; accepted: a regular file without links; delete"

Plant = Callable[..., None]


@pytest.fixture(params=LINKS)
def plant(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Plant]:
    """Yield a function that makes paths links to a file, which is unchanged after the test."""
    victim = tmp_path / "victim"
    victim.write_bytes(CONTENT)

    def planted(*paths: Path) -> None:
        for path in paths:
            path.unlink(missing_ok=True)
            LINKS[request.param](path, victim)

    yield planted
    assert victim.read_bytes() == CONTENT


@pytest.fixture
def outside(tmp_path: Path) -> Iterator[Path]:
    """A folder of the user that stays empty."""
    folder = tmp_path / "outside"
    folder.mkdir()
    yield folder
    assert not any(folder.iterdir())


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demo_run(tmp_path_factory.mktemp("demo") / "run", episodes=1)[0].path


@pytest.fixture
def run(demo: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(demo, tmp_path / "run"))


WRITERS: dict[str, Callable[[Path], object]] = {
    "verdict.json": lambda path: files.write_json(path, {"schema": 1}),
    "report.html": lambda path: files.replace_file(path, b"<html>"),
    "latency.npz": lambda path: files.add_arrays(path, {"000": {"t": np.arange(3)}}),
    "arrays.npz": lambda path: files.save_arrays(path, {"t": np.arange(3)}),
    "signing.key": lambda path: write_key(path, bytes(range(32))),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_written_file_replaces_links(name: str, plant: Plant, tmp_path: Path) -> None:
    path = tmp_path / name
    WRITERS[name](path)
    wanted = path.read_bytes()
    path.unlink()
    plant(path.with_name(f"{name}.partial"))
    WRITERS[name](path)
    assert path.read_bytes() == wanted
    if name != "latency.npz":  # to which groups are added
        plant(path)
        WRITERS[name](path)
        assert path.read_bytes() == wanted
    assert not path.is_symlink()
    assert path.stat().st_nlink == 1


def test_a_key_is_for_its_owner_alone(tmp_path: Path) -> None:
    write_key(tmp_path / "key", bytes(range(32)))
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o600


def test_a_log_replaces_links(plant: Plant, tmp_path: Path) -> None:
    for name in ("flight-000.tlog", "flight-000.ulg"):
        plant(tmp_path / name, tmp_path / f"{name}.part")
        log = files.LogFile(tmp_path / name)
        log.add(0, b"record")
        log.close()
        assert (tmp_path / name).read_bytes() == b"record"
        assert not (tmp_path / name).is_symlink()


def test_lines_are_not_appended_to_links(plant: Plant, run: Path) -> None:
    plant(run / EPISODES_FILE)
    with pytest.raises(UsageError, match=f"{EPISODES_FILE}: {REFUSED} {EPISODES_FILE}"):
        files.append_lines(run / EPISODES_FILE, [{"schema": 1}])


def test_arrays_are_not_appended_to_links(plant: Plant, run: Path) -> None:
    plant(run / "latency.npz")
    for write in (WRITERS["latency.npz"], lambda path: files.close_archive(path, {"000"})):
        with pytest.raises(UsageError, match=rf"latency\.npz: {REFUSED}"):
            write(run / "latency.npz")


def test_a_resumed_run_does_not_truncate_links(plant: Plant, run: Path) -> None:
    plant(run / EPISODES_FILE)
    with pytest.raises(UsageError, match=f"{EPISODES_FILE}: a link"):
        RunFolder.resume(run)


def test_a_log_of_a_process_is_no_link(plant: Plant, run: Path) -> None:
    plant(run / "firmware.log")
    with pytest.raises(UsageError, match=rf"firmware\.log: {REFUSED}"):
        ChildProcess([sys.executable, "-c", "print(1)"], run / "firmware.log")


@pytest.mark.parametrize("kind", ["pipe", "folder", "nowhere"])
def test_lines_are_appended_to_regular_files_alone(kind: str, tmp_path: Path) -> None:
    path = tmp_path / EPISODES_FILE
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to(tmp_path / "nowhere")
    with pytest.raises(UsageError, match=re.escape(REFUSED)):
        files.append_lines(path, [{"schema": 1}])
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("target", ["temporary", "final"])
def test_a_report_writes_its_folder_alone(target: str, plant: Plant, run: Path) -> None:
    kept = {path.name for path in run.iterdir()}
    options = report_command.ReportOptions(runs=(run,), figures=("pdf",))
    report_command.run(options, QUIET)
    written = {path.name: path.read_bytes() for path in run.iterdir() if path.name not in kept}
    assert {"report.html", "verdict.json", "latency.png", "latency-t2.pdf"} <= written.keys()
    # The verdict is read before it is written.
    ends = {name: f"{name}.partial" if target == "temporary" else name for name in written}
    plant(*(run / end for end in ends.values() if end != "verdict.json"))
    report_command.run(options, QUIET)
    for name in written:
        assert not (run / name).is_symlink()
        assert (run / name).stat().st_nlink == 1
        if not name.endswith((".json", ".pdf")):
            assert (run / name).read_bytes() == written[name]


def test_exports_write_their_folder_alone(plant: Plant, run: Path) -> None:
    temporary = [run / f"flight-000{end}" for end in (".ulg.part", ".mcap.partial")]
    plant(*temporary)
    for kind in ("ulog", "mcap"):
        export_log.run(export_log.ExportLogOptions(run=run, format=kind), QUIET)
    assert (run / "flight-000.ulg").read_bytes().startswith(b"ULog")


@pytest.mark.parametrize("target", ["outside", "/dev/zero"])
def test_a_linked_log_is_not_copied(target: str, run: Path, tmp_path: Path) -> None:
    (tmp_path / "outside").write_bytes(CONTENT)
    (run / "flight-000.ulg").symlink_to(tmp_path / target)
    with pytest.raises(UsageError, match=r"flight-000\.ulg: a link out of its folder; accepted"):
        export_log.run(export_log.ExportLogOptions(run=run, format="ulog", out=tmp_path), QUIET)
    assert not (tmp_path / "flight-000.ulg").exists()


@pytest.mark.parametrize("name", ["run.json", "episodes.jsonl", "latency.npz"])
def test_links_out_of_a_run_are_not_read(name: str, run: Path, tmp_path: Path) -> None:
    (run / name).rename(tmp_path / name)
    (run / name).symlink_to(tmp_path / name)
    with pytest.raises(UsageError, match=f"{name}: a link out of its folder"):
        load(run)
    (run / "kept").write_bytes((tmp_path / name).read_bytes())
    (run / name).unlink()
    (run / name).symlink_to(run / "kept")  # In the folder.
    assert load(run).episodes


def test_a_report_goes_elsewhere_on_request(run: Path, tmp_path: Path) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in run.iterdir()}
    out = tmp_path / "pages"
    options = report_command.ReportOptions(runs=(run,), figures=("svg",), out=out)
    assert report_command.run(options, QUIET) == 0
    assert {path.name: path.stat().st_mtime_ns for path in run.iterdir()} == before
    names = {path.name for path in out.iterdir()}
    assert {"report.html", "verdict.json", "latency.png", "latency-t2.svg"} <= names


def test_a_planted_folder_does_not_stop_a_resumed_run(run: Path, outside: Path) -> None:
    (run / "x.partial" / "y").mkdir(parents=True)
    (run / "z.partial").symlink_to(outside)
    folder, _ = RunFolder.resume(run)
    folder.sweep()
    assert not any(os.path.lexists(run / name) for name in ("x.partial", "z.partial"))
    assert outside.exists()


def test_a_picture_replaces_links(plant: Plant, tmp_path: Path) -> None:
    out = tmp_path / "some.png"
    plant(out, tmp_path / "some.png.partial")
    words = ["no-obstacles", "--width-px", "16", "--height-px", "12", "--samples", "1"]
    words += ["--out", str(out)]
    assert carry_out("airl render", "airl_mav.addons.colour.command", words, console=QUIET) == 0
    assert out.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("form", ["csv", "parquet", "lerobot", "minari"])
def test_a_data_set_is_not_written_through_a_link(form: str, run: Path, outside: Path) -> None:
    (run / f"data-{form}").symlink_to(outside)
    with pytest.raises(UsageError, match=f"data-{form}: a link; accepted: a folder; delete"):
        export_data.run(export_data.ExportDataOptions(run=run, format=form), QUIET)


def test_the_user_may_name_a_link(run: Path, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    options = export_data.ExportDataOptions(run=run, format="csv", out=tmp_path / "link")
    assert export_data.run(options, QUIET) == 0
    assert (tmp_path / "disk" / "episodes.csv").exists()


@pytest.mark.parametrize("name", ["checkpoints", "tensorboard", "best", "zones", "policy"])
def test_a_training_is_not_written_through_a_link(name: str, outside: Path, run: Path) -> None:
    (run / name).symlink_to(outside)
    with pytest.raises(UsageError, match=f"{name}: a link; accepted: a folder"):
        TrainingFolder(run)


def test_a_recording_is_not_unpacked_through_a_link(
    outside: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "flight.mcap").write_bytes(b"")
    (tmp_path / "flight").symlink_to(outside)
    monkeypatch.setattr(mcap_file, "read_black_box", lambda _: None)
    with pytest.raises(UsageError, match="flight: a link; accepted: a folder"):
        recorded_flight.take_in(tmp_path / "flight.mcap")


def test_a_cell_is_not_flown_through_a_link(outside: Path, tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(outside)
    cell: Any = SimpleNamespace(name="a", scenario=None)
    executor: Any = None
    with pytest.raises(UsageError, match="a: a link; accepted: a folder"):
        campaign.run_cells(tmp_path, [cell], executor)


def test_a_killed_writer_leaves_nothing_for_the_next_run(run: Path) -> None:
    before = (run / "latency.npz").read_bytes()
    writer = files.replacing(run / "latency.npz")
    partial = writer.__enter__()
    partial.write_bytes(b"half")
    assert (run / "latency.npz").read_bytes() == before
    folder, _ = RunFolder.resume(run)
    folder.sweep()
    assert not partial.exists()
    assert load(run).latency
