"""Notebook output of a run or a comparison: the verdict, key figures, one picture."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path

from airl_mav.arena.geometry import Arena
from airl_mav.core.errors import UsageError
from airl_mav.rehearsal.run_folder import LoadedRun, arenas_of, flown_path, vehicle_of
from airl_mav.report.comparison.comparison_model import Comparison
from airl_mav.report.comparison.show import comparison_to_document
from airl_mav.report.comparison.tables import runs_table
from airl_mav.report.document import Headline, TableView, columns_of, environment
from airl_mav.report.measures import MEASURES, summarize_run
from airl_mav.report.plotly_scene import SceneFlight, top_speed
from airl_mav.report.run_figures import map_figure, overview_picture
from airl_mav.report.run_report import pictured, run_headlines
from airl_mav.report.run_verdict import OverallVerdict, load_verdict, verdict_of
from airl_mav.report.theme import FigureImage


def run_html(run: LoadedRun) -> str:
    """Return a run as HTML, without arenas if they cannot be generated."""
    verdict = verdict_of(run)
    table = _figures(run_headlines(run, summarize_run(run)))
    picture = _picture(run) if run.episodes else None
    return _html(verdict, table, picture, f"{run.path}")


def comparison_html(
    comparison: Comparison, loaded: Mapping[str, LoadedRun], folder: Path, page: Path
) -> str:
    """Return a comparison in a folder as HTML with a link to its page."""
    verdict = load_verdict(folder)
    document = comparison_to_document(comparison, loaded, folder, verdict)
    table = runs_table(comparison.runs, measures=MEASURES)
    drawing = next((section.draw for section in document.sections if section.draw), None)
    pictures = () if drawing is None else drawing()
    return _html(verdict, table, next(iter(pictures), None), f"{page}")


def _figures(headlines: list[Headline]) -> TableView:
    columns = columns_of("<measure | value | 95 % interval, n")
    rows = tuple((each.title, f"{each.value} {each.unit}", each.detail) for each in headlines)
    return TableView("figures", "", columns, rows)


def _picture(run: LoadedRun) -> FigureImage:
    arenas = _arenas(run)
    if len(run.episodes) > 1:
        return overview_picture(run, arenas)
    (record,) = run.episodes
    path, arena = flown_path(run, record), arenas.get(record.index)
    top = 0.0 if path is None else top_speed([SceneFlight(record, path, arena)])
    return map_figure(record, path, arena, top)


def _arenas(run: LoadedRun) -> dict[int, Arena]:
    try:
        return arenas_of(pictured(run), vehicle_of(run.info))
    except UsageError:
        return {}


def _html(
    verdict: OverallVerdict, table: TableView | None, picture: FigureImage | None, place: str
) -> str:
    image = None if picture is None else base64.b64encode(picture.png).decode()
    return (
        environment()
        .get_template("notebook.html.j2")
        .render(
            lines=verdict.lines,
            table=table,
            image=image,
            alt="" if picture is None else picture.alt,
            place=place,
        )
    )
