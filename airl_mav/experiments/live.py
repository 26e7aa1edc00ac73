"""Sequential flights for `airl-sitl`; light to import, to start processes immediately."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from airl_mav.core import child_process, errors, first_start
from airl_mav.core.progress import Progress
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.lockstep.turns import LockstepError
from airl_mav.rehearsal.live_view import ViewAddresses, ViewError, ViewRequest, view_part
from airl_mav.rehearsal.observer import LiveObserver, Observer
from airl_mav.rehearsal.rehearsal import Rehearsal, RehearsalError
from airl_mav.rehearsal.run_folder import RUN_FILE, locked, open_folder
from airl_mav.scenario.resolve import ResolvedScenario, plan_of
from firmware_sim.external.programs import check_program

Ended = Literal["complete", "interrupted", "broken off"]


EXIT_CODES: dict[Ended, int] = {
    "complete": 0,
    "interrupted": errors.EXIT_INTERRUPTED,
    "broken off": errors.EXIT_BROKEN,
}


@dataclass(frozen=True)
class FlownRun:
    """Result of a run."""

    path: Path
    ended: Ended
    episodes: tuple[EpisodeRecord, ...]
    """All episodes in the folder, by index."""
    new: int
    """Number of episodes flown by this call."""
    problem: str = ""


def fly_live(
    scenario: ResolvedScenario,
    out: Path | None,
    progress: Progress,
    *,
    name: str | None = None,
    announce: Callable[[], None] = lambda: None,
    view: ViewRequest | None = None,
) -> FlownRun:
    """Fly the rest of a scenario, one flight after the other, at level sitl or lockstep."""
    asked = scenario.scenario
    if asked.level == "gym":
        raise errors.FieldError(
            "level", asked.level, "lockstep or sitl; airl evaluate flies the vectorized simulator"
        )
    check_program(asked)
    say = partial(progress.note, style="yellow")
    known = out is not None and (out / RUN_FILE).exists()
    with ExitStack() as held, child_process.terminated_as_interrupted():
        if out is not None:
            # Lock first: processes of a killed run may still be writing.
            keeps = held.enter_context(locked(out, say))
        name = name or f"{asked.level}-{scenario.policy.name}"
        folder, done = open_folder(out, name, scenario, say)
        if out is None:
            keeps = held.enter_context(locked(folder.path, say))
        if done:
            progress.note(f"{folder.path}: {len(done)} of {asked.episodes} episodes are there")
        if len(done) == asked.episodes:
            return FlownRun(folder.path, "complete", done, 0)
        announce()
        live = LiveObserver(progress, folder.path, done, asked.episodes)
        observer: Observer = live
        ends: ViewAddresses | None = None
        indices = {record.index for record in done}
        ended: Ended = "complete"
        problem = ""
        try:
            # Compile before any process waits for another one.
            first_start.compile_first([plan_of(scenario)], progress)
            if view is not None:
                ends, observer = held.enter_context(_watched(scenario, view, live, progress))
            if asked.level == "lockstep":
                # Imported here: level sitl starts its processes sooner without the simulator.
                from airl_mav.lockstep.lockstep_flight import rehearse

                rehearse(scenario, folder, observer, indices, ends)
            else:
                with Rehearsal(scenario, folder, observer, (keeps,), ends) as rehearsal:
                    rehearsal.run(done=indices)
        except (RehearsalError, LockstepError) as error:
            ended, problem = "broken off", str(error)
        except KeyboardInterrupt:
            ended = "interrupted"
        except errors.UsageError:
            if not known and not live.finished_records:
                folder.discard()
            raise
        finally:
            live.close()
            folder.sweep()
            folder.close()
        tell_end(folder.path, ended, problem, progress)
        new = live.finished_records
        episodes = tuple(sorted((*done, *new), key=lambda record: record.index))
        return FlownRun(folder.path, ended, episodes, len(new), problem)


@contextmanager
def _watched(
    scenario: ResolvedScenario, asked: ViewRequest, onwards: Observer, progress: Progress
) -> Iterator[tuple[ViewAddresses, Observer]]:
    """Start a viewer; yield its connections and an observer that also notifies `onwards`."""
    onwards.waiting("starting the view")
    name = f"{scenario.policy.name} in {scenario.arena_name}, {scenario.level}"
    try:
        started = view_part("viewer")(view_part("flights")(scenario, name, asked.port))
    except ViewError as error:
        raise RehearsalError(str(error)) from None
    with closing(started) as viewer:
        progress.note(f"view       {viewer.url}")
        with closing(view_part("observer")(viewer.ends, onwards)) as observer:
            observer.waiting("starting")
            yield viewer.ends, observer


def tell_end(path: Path, ended: Ended, problem: str, progress: Progress) -> None:
    """Report why a run ended early, and how to resume it."""
    if problem:
        progress.note(f"error: {problem}", "red")
    if ended != "complete":
        progress.note(f"{ended}: finished flights are kept; resume with --out {path}", "yellow")
