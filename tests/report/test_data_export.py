"""Data of a run outside: tables, CSV, Parquet, and data sets that Minari and pandas read."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import minari
import numpy as np
import pandas
import pytest

from airl_mav import Run, Scenario, load_run, rehearse
from airl_mav.addons.data_export.export_data import ExportDataOptions, run
from airl_mav.cli import report_command
from airl_mav.cli.report_command import ReportOptions
from airl_mav.core.errors import UsageError
from airl_mav.latency.stamps import NO_STAMP
from airl_mav.report.run_columns import decision_columns


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Two flights of the vectorized simulator."""
    out = tmp_path_factory.mktemp("runs") / "two"
    return rehearse(Scenario(level="gym", episodes=2, seed=7), out=out)


def test_tables_contain_the_arrays_of_the_run(flown: Run) -> None:
    decisions = pandas.DataFrame(flown.table("decisions"))
    for index, stamps in flown.stamps.items():
        rows = decisions[decisions.episode == index]
        assert rows.sent_us.to_list() == stamps["sent_us"].tolist()
        t2 = (stamps["action_ready_us"] - stamps["infer_start_us"]) / 1000.0
        assert np.allclose(rows.t2_ms, t2)
        at = flown.trajectories[index].at(stamps["sent_us"])
        assert np.allclose(rows.north_m, at.position[:, 0])
    episodes = flown.table()
    assert episodes["quality.distance_m"] == [
        each.quality.distance_m for each in flown.episodes if each.quality is not None
    ]
    samples = sum(len(path) for path in flown.trajectories.values())
    assert len(flown.table("trajectories")["time_us"]) == samples


def test_an_unsent_decision_has_no_state(flown: Run) -> None:
    stamps = dict(flown.stamps[0])
    stamps["sent_us"] = np.append(stamps["sent_us"][:-1], NO_STAMP)
    columns = decision_columns(replace(flown._loaded, latency={0: stamps}))
    assert np.isnan(columns["north_m"]).tolist() == [False] * (len(stamps["sent_us"]) - 1) + [True]


def test_csv_and_parquet_equal_the_tables(flown: Run, tmp_path: Path) -> None:
    for form in ("csv", "parquet"):
        options = ExportDataOptions(run=flown.path, format=form, out=tmp_path / form)
        assert run(options) == 0
    for name in ("episodes", "decisions", "latency", "trajectories"):
        table = pandas.DataFrame(flown.table(name))
        pandas.testing.assert_frame_equal(
            pandas.read_parquet(tmp_path / "parquet" / f"{name}.parquet"),
            table,
            check_dtype=False,
        )
        with (tmp_path / "csv" / f"{name}.csv").open(newline="", encoding="utf-8") as file:
            lines = list(csv.reader(file))
        assert lines[0] == list(table.columns)
        assert len(lines) == 1 + len(table)


def test_minari_reads_states_and_setpoints(
    flown: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    assert run(ExportDataOptions(run=flown.path, format="minari", out=tmp_path / "two")) == 0
    episodes = list(minari.load_dataset("two-v0"))
    assert len(episodes) == len(flown.episodes)
    for episode, record in zip(episodes, flown.episodes, strict=True):
        sent = flown.stamps[record.index]["sent_us"]
        first = flown.trajectories[record.index].at(sent[:1])
        assert np.allclose(episode.observations[0][:3], first.position[0], atol=1e-5)
        assert np.array_equal(episode.actions[0], flown.stamps[record.index]["setpoint"][0])
        assert episode.rewards.sum() == (1.0 if record.outcome.value == "success" else 0.0)


def test_a_lerobot_data_set_is_consistent(flown: Run, tmp_path: Path) -> None:
    out = tmp_path / "lerobot"
    assert run(ExportDataOptions(run=flown.path, format="lerobot", out=out)) == 0
    info = json.loads((out / "meta" / "info.json").read_text())
    frames = pandas.read_parquet(out / "data" / "chunk-000" / "file-000.parquet")
    episodes = pandas.read_parquet(out / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    assert info["total_frames"] == len(frames) == episodes.length.sum()
    assert set(info["features"]) == set(frames.columns)
    for name in ("observation.state", "action"):
        assert [len(frames[name][0])] == info["features"][name]["shape"]
    assert frames["index"].to_list() == list(range(len(frames)))
    assert pandas.read_parquet(out / "meta" / "tasks.parquet").index.to_list() == [
        "fly to the goal"
    ]


def test_a_used_folder_and_a_missing_run_are_one_line(flown: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UsageError, match="exists already"):
        run(ExportDataOptions(run=flown.path, out=tmp_path))
    with pytest.raises(UsageError):
        run(ExportDataOptions(run=tmp_path / "none"))
    assert load_run(flown.path).complete


def test_figures_are_written_as_pdf_and_svg(flown: Run) -> None:
    assert report_command.run(ReportOptions(runs=(flown.path,), figures=("pdf", "svg"))) == 0
    written = {path.suffix: path for path in sorted(flown.path.glob("*.[ps][dv][fg]"))}
    assert written[".pdf"].read_bytes().startswith(b"%PDF")
    assert "<svg" in written[".svg"].read_text(encoding="utf-8")
