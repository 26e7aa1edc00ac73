"""`airl evaluate`: fly policies through seeded episodes and print statistics with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli import shared_options
from airl_mav.cli.options import POSITIONAL, scenario_of
from airl_mav.cli.shared_options import ExperimentOptions, Gate, Viewing, Voice
from airl_mav.core import errors, fields

if TYPE_CHECKING:
    from airl_mav.experiments.live import FlownRun
    from airl_mav.flight.requirements import Requirement


class EvaluateOptions(Gate, Viewing, ExperimentOptions):
    """Fly policies through seeded episodes: success, time, distance and energy with intervals.

    Several policies or arenas give a table of policies x arenas. The same --out resumes an
    interrupted evaluation; a finished evaluation prints its tables again. airl report RUN draws the
    page of a run.

    Examples:
        airl evaluate static-obstacles --episodes 1000
        airl evaluate static-obstacles dense-obstacles --arena static-obstacles crowded
        airl evaluate static-obstacles --level lockstep --computer ras-pi-4 --workload template-5x32
        airl evaluate static-obstacles --level lockstep --each-fault --fault 'gps off at hold'
        airl evaluate runs/train-mine/policy --on-card
    """

    policies: Annotated[tuple[str, ...], POSITIONAL] = Field(
        default=(), description="names, or paths to folders with policy.onnx and card.json"
    )
    arena: Annotated[tuple[str, ...], fields.COMMON, "arena"] = Field(
        default=(),
        description="arena profiles: shipped names, or paths to .toml files; by default those that"
        " the policies were trained in, or static-obstacles",
    )
    episodes: int = shared_options.episodes("number of episodes in each arena", 100)
    each_fault: bool = Field(
        default=False,
        description="fly every policy healthy and with each fault alone, a row each, instead of"
        " with all of them at once",
    )
    on_card: Annotated[bool, fields.COMMON, "output"] = Field(
        default=False,
        description="write the results onto the policies' cards, in place of earlier ones of the"
        " same arena, level and latency",
    )
    out: Annotated[Path | None, fields.COMMON, "output"] = Field(
        default=None,
        description="run folder, or with several policies or arenas the folder of their run"
        " folders; by default runs/<UTC time>-...",
    )


OPTIONS = EvaluateOptions


def run(options: EvaluateOptions, console: Console | None = None) -> int:
    """Evaluate; return 0, 1 (workers lost), 3 to 5 (verdict) or 130 (Ctrl-C)."""
    # Imported here and below: options do not need the simulator.
    from airl_mav.experiments.evaluate import check_plain, evaluation_cells, matrix, write_on_card
    from airl_mav.experiments.experiment import fly_scenario, known_seeds, run_name
    from airl_mav.experiments.live import fly_live
    from airl_mav.rehearsal.host_pace import host_warning

    voice = Voice(options, "airl evaluate", console)
    scenario = scenario_of(options, policy=options.policies[0] if options.policies else None)
    each_fault = options.each_fault
    cells = evaluation_cells(scenario, options.policies, options.arena, each_fault=each_fault)
    view = shared_options.view_of(options)
    if view is not None and (len(cells) > 1 or options.level == "gym"):
        problem = "accepted: with one policy in one arena, at level lockstep or sitl"
        raise errors.FieldError("view", True, problem=problem)
    if options.on_card:
        check_plain(cells)
    if len(cells) > 1:
        experiment = matrix(scenario, options.policies, options.arena, each_fault=each_fault)
        code, compared = shared_options.fly_and_show(
            experiment, options.out, console, options, options
        )
        for run in compared.cells if options.on_card else ():
            if run.complete:
                write_on_card(run.cell, run.episodes)
        return code
    (cell,) = cells
    requirements = shared_options.requirements_of(options, reference=False)
    with voice:
        progress = voice.progress
        for warning in filter(None, (*known_seeds(cells), host_warning(cell.scenario.scenario))):
            progress.note(warning, "yellow")
        if view is None:
            flown = fly_scenario(cell.scenario, options.out, progress)
        else:
            # Sequential flights, in the order of the viewer.
            name = run_name(cell.scenario)
            flown = fly_live(cell.scenario, options.out, progress, name=name, view=view)
        if options.on_card and flown.ended == "complete":
            write_on_card(cell, flown.episodes)
        return _show(flown, options, requirements, voice)


def _show(flown: FlownRun, gate: Gate, requirements: Sequence[Requirement], voice: Voice) -> int:
    from airl_mav.experiments.live import EXIT_CODES
    from airl_mav.flight.episode_record import run_sha256
    from airl_mav.rehearsal.run_folder import load
    from airl_mav.report.document import REPORT_FILE
    from airl_mav.report.run_tables import show_report
    from airl_mav.report.run_verdict import verdict_of

    code = EXIT_CODES[flown.ended]
    if not flown.episodes:
        voice.console.print(f"no episode was finished; {flown.path}", soft_wrap=True)
        voice.finish(code, flown.ended, flown.path)
        return code
    loaded = load(flown.path)
    verdict = verdict_of(loaded, requirements)
    more: list[str] = []
    if flown.ended == "complete":
        shared_options.leave(gate, verdict, "airl evaluate")
        code = verdict.exit_code
        if (sha256 := run_sha256(flown.episodes)) is not None:
            more = [f"sha256 of the flights  {sha256}"]
    # Redraw a page that shows fewer flights or another verdict.
    drawn = (flown.path / REPORT_FILE).exists()
    page = show_report(loaded, verdict, voice.console, voice.progress, draw=drawn)
    for line in more:
        voice.console.print(line, soft_wrap=True, highlight=False)
    runs = {flown.path.name: loaded}
    voice.finish(code, flown.ended, flown.path, verdict=verdict, page=page, runs=runs, more=more)
    return code
