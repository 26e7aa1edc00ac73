"""A new figure of a run's page takes two files: one for its section, and the table of sections.

Here this file stands for the first, and `enter` for the line in `run_report.SECTIONS`.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from airl_mav.arena.geometry import Arena
from airl_mav.rehearsal.run_folder import LoadedRun, load
from airl_mav.report import run_report, theme
from airl_mav.report.document import Section
from airl_mav.report.run_report import SECTIONS, PageSection, ReportInput, build_page
from tests.support.page_alone import unpacked
from tests.support.run_demo import write_demo_run

TITLE = "Top speeds"


def speeds_section(page: ReportInput) -> list[Section]:
    """Return a figure of the top speed of each flight; empty without measured flights."""
    speeds = [e.quality.max_speed_m_s for e in page.run.episodes if e.quality is not None]
    if not speeds:
        return []
    return [Section(TITLE, draw=lambda: [speeds_figure(speeds)], note="One bar per flight.")]


def speeds_figure(speeds: list[float]) -> theme.FigureImage:
    """Draw top speeds [m/s] as bars."""
    figure = theme.new_figure(4.2, 2.6)
    ax = figure.subplots()
    ax.bar(range(len(speeds)), speeds, color=theme.SERIES)
    theme.label_axes(ax, "flight", "m/s")
    return theme.render(figure, "speeds", f"Top speeds of {len(speeds)} flights")


def enter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the section to the table, before the last one."""
    row = PageSection("speeds", TITLE, speeds_section)
    monkeypatch.setattr(run_report, "SECTIONS", (*SECTIONS[:-1], row, SECTIONS[-1]))


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[LoadedRun, dict[int, Arena]]:
    folder, arenas = write_demo_run(tmp_path_factory.mktemp("run") / "demo", episodes=2)
    return load(folder.path), arenas


def test_a_new_section_is_on_the_page_and_in_its_contents(
    demo: tuple[LoadedRun, dict[int, Arena]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    enter(monkeypatch)
    page = build_page(*demo, tmp_path).read_text(encoding="utf-8")
    nav = re.findall(r'<a href="#([\w-]+)">(.*?)</a>', page[page.index("<nav") :])
    assert nav[-2:] == [("speeds", TITLE), ("made", "How it was made")]
    begin = page.index('<section id="speeds">')
    section = page[begin : page.index("</section>", begin)]
    assert f"<h2>{TITLE}</h2>" in section
    assert 'data-picture="speeds"' in section
    assert 'alt="Top speeds of 2 flights"' in section
    assert '<p class="note">One bar per flight.</p>' in section
    packed = page[page.index('id="page-data">') + len('id="page-data">') :]
    pictures = json.loads(unpacked(packed[: packed.index("<")]))["pictures"]
    assert pictures["speeds"].startswith("<svg")
    assert (tmp_path / "speeds.png").stat().st_size > 1000


def test_a_section_without_contents_leaves_no_trace(
    demo: tuple[LoadedRun, dict[int, Arena]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    enter(monkeypatch)
    run, _ = demo
    empty = LoadedRun(run.path, run.info, (), {}, {})
    page = build_page(empty, {}, tmp_path).read_text(encoding="utf-8")
    assert "speeds" not in page
    assert TITLE not in page
    assert not list(tmp_path.glob("*.png"))


def test_anchors_are_unique() -> None:
    anchors = [entry.anchor for entry in SECTIONS if entry.anchor]
    assert len(set(anchors)) == len(anchors)
