"""`airl-sitl`, `airl sitl`: rehearse a policy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field
from rich.console import Console

from airl_mav.cli import shared_options
from airl_mav.cli.options import check_installed, run_command, scenario_of
from airl_mav.core.addons import load_entry
from airl_mav.core.constants import LOOPBACK
from airl_mav.core.fields import COMMON
from airl_mav.experiments.live import EXIT_CODES, FlownRun, fly_live
from airl_mav.policy.card import weak_arenas
from airl_mav.rehearsal import host_pace
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import ResolvedScenario, resolve
from firmware_sim.external.programs import how_to_start

if TYPE_CHECKING:
    from airl_mav.flight.requirements import Requirement


class SitlOptions(shared_options.Gate, shared_options.Viewing, shared_options.Telling, Scenario):
    """Rehearse a policy: firmware and companion as two processes, seeded episodes, a report.

    If the first word ends in .toml, it is a scenario file; options override its values. A run
    folder contains scenario.toml, which repeats the run.

    Examples:
        airl-sitl --vehicle quad
        airl-sitl --computer ras-pi-4 --workload template-5x32 --episodes 10
        airl-sitl --level lockstep --policy dynamic-obstacles --arena crowded
        airl-sitl --level lockstep --arena dynamic-obstacles --view
        airl-sitl rehearsal.toml --latency 150ms --require "success >= 90 %"
    """

    out: Annotated[Path | None, COMMON, "output"] = Field(
        default=None,
        description="run folder; an incomplete folder of the same run is completed; default:"
        " runs/<UTC time>-<level>-<policy>",
    )

    video: Annotated[str | None, "output"] = Field(
        default=None,
        description="show what the camera sees as a video, to HOST:PORT; 127.0.0.1:5600 is where"
        " QGroundControl on this machine listens",
    )

    tables: Annotated[bool, COMMON, "output"] = Field(
        default=False, description="print the tables of the report before the verdict"
    )


OPTIONS = SitlOptions


def run(options: SitlOptions, console: Console | None = None) -> int:
    """Fly the rest, write the report; return 0, 1 (lost), 3 to 5 (verdict) or 130 (Ctrl-C)."""
    voice = shared_options.Voice(options, "airl-sitl", console)
    requirements = shared_options.requirements_of(options, reference=False)
    view = shared_options.view_of(options)
    scenario = resolve(scenario_of(options))
    warning = host_pace.host_warning(scenario.scenario)
    film = video_of(options, scenario.scenario, partial(_say, voice.console))
    with voice, film:
        if warning:
            voice.progress.note(f"{warning}; --level lockstep needs no real time", "yellow")
        if caution := weakness(scenario):
            voice.progress.note(caution, "yellow")
        flown = fly_live(
            scenario,
            options.out,
            voice.progress,
            announce=partial(_announce, scenario, voice.console),
            view=view,
        )
        judged = conclude(flown, options, requirements, voice)
    return EXIT_CODES[flown.ended] or judged


def weakness(scenario: ResolvedScenario) -> str:
    """Return a warning if the policy's card has a low success rate in this arena; empty if not."""
    policy, arena = scenario.policy, scenario.arena_name
    weak = weak_arenas(() if policy.card is None else policy.card.results)
    rate = {Path(name).stem: each for name, each in weak.items()}.get(arena)
    told = f"warning: {policy.name} reaches {rate or 0.0:.0%} of the goals in {arena}, by its card"
    return "" if rate is None else f"{told}; airl evaluate planner compares"


def video_of(
    options: SitlOptions, asked: Scenario, say: Callable[[str], None]
) -> AbstractContextManager[None]:
    """Return a context that shows the camera's video, if requested."""
    if options.video is None:
        return nullcontext()
    show = load_entry("airl_mav", "SITL_OPTIONS", "video", ("video", options.video), "video")
    check_installed("film")
    shown: AbstractContextManager[None] = show(asked, options.video, say)
    return shown


def conclude(
    flown: FlownRun,
    options: SitlOptions,
    requirements: Sequence[Requirement],
    voice: shared_options.Voice,
) -> int:
    """Write the report of the flights and print the verdict; return the verdict's exit status."""
    if not flown.episodes:
        _say(voice.console, f"no episode was finished; logs in {flown.path}")
        voice.finish(EXIT_CODES[flown.ended], flown.ended, flown.path)
        return 0
    # Imported here: the figures take seconds to load, which flights do not need.
    from airl_mav.rehearsal.run_folder import load
    from airl_mav.report.run_tables import show_report
    from airl_mav.report.run_verdict import verdict_of

    run = load(flown.path)
    verdict = verdict_of(run, requirements)
    if flown.ended == "complete":
        shared_options.leave(options, verdict, "airl-sitl")
    page = show_report(run, verdict, voice.console, voice.progress, tables=options.tables)
    voice.finish(
        EXIT_CODES[flown.ended] or verdict.exit_code,
        flown.ended,
        flown.path,
        verdict=verdict,
        page=page,
        runs={flown.path.name: run},
    )
    return verdict.exit_code


def _announce(scenario: ResolvedScenario, console: Console) -> None:
    asked, setup = scenario.scenario, scenario.setup
    _say(console, f"airl-sitl  {asked.vehicle} in {asked.arena}, policy {scenario.policy.name}")
    _say(console, f"firmware   {setup.firmware}")
    if asked.level != "sitl":
        _say(console, "lockstep   one process, one simulated clock, MAVSDK on raw bytes")
        if setup.level != "firmware":
            return
    else:
        _say(console, f"MAVSDK     udpin://{LOOPBACK}:{asked.companion_port} (the companion's)")
    if asked.firmware != "attach":
        _say(console, f"QGC        UDP port {asked.ports.gcs_port} (connects by itself)")
    if setup.level == "firmware" and (hint := how_to_start(asked, scenario.vehicle)) is not None:
        _say(console, f"           start one for every flight: {hint}")


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, highlight=False)


if __name__ == "__main__":
    run_command("airl-sitl", "airl_mav.cli.sitl_command")
