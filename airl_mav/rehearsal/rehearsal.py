"""Rehearsal: two processes, N seeded episodes and one run folder, robust to process failures.

A complete episode is saved. An episode that lost a process is flown again by two new ones, from its
seed. So is an episode that the host disturbed. The records contain only a note of such attempts. An
episode still invalid after the last attempt is saved as invalid.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from airl_mav.core.clock import WallClock
from airl_mav.core.compiling import COMPILING
from airl_mav.core.constants import MAX_ATTEMPTS, US_PER_S
from airl_mav.flight.judge import BY_HAND, Referee, TruthSample, Verdict
from airl_mav.rehearsal import channel, live_view, process_pair, run_folder
from airl_mav.rehearsal.episode import (
    TAKEOFF_LIMIT_S,
    EpisodeSupervisor,
    Order,
    RunningEpisode,
    disturbances,
    disturbing,
    join_episode,
)
from airl_mav.rehearsal.observer import FLOWN_AGAIN, WARNING, Observer
from airl_mav.scenario.resolve import ResolvedScenario
from firmware_sim.external.programs import behind_us, load_timeout_s

WRAP_UP_S = 90.0
"""Maximum time from the verdict to the companion's report, including landing [simulated s]."""

SEPARATED_BY = "firmware and companion lost each other"


class RehearsalError(Exception):
    """Error that ends the run; the message contains the cause."""


class Rehearsal:
    """Flies a scenario. As a context manager, it always ends both processes."""

    def __init__(
        self,
        scenario: ResolvedScenario,
        folder: run_folder.RunFolder,
        observer: Observer,
        keeps: Sequence[int] = (),
        view: live_view.ViewAddresses | None = None,
    ) -> None:
        """Take the scenario without starting it. The processes inherit the locks in `keeps`."""
        self._view = view
        self._scenario = scenario
        self._speed = scenario.speed or 1.0
        self._folder = folder
        self._observer = observer
        self._keeps = keeps
        self._pair: process_pair.ProcessPair | None = None
        self._poses = ""
        """Source of the poses of a vehicle elsewhere."""

    def __enter__(self) -> Rehearsal:
        """Return the rehearsal."""
        return self

    def __exit__(self, *_: object) -> None:
        """End both processes."""
        self._dismiss()

    def run(self, done: Collection[int] = ()) -> None:
        """Fly and save the episodes not in `done`. Raises RehearsalError after repeated losses."""
        for index, seed in enumerate(self._scenario.scenario.seeds):
            if index not in done:
                self._fly_surely(index, seed)

    def _fly_surely(self, index: int, seed: int) -> None:
        """Fly an episode and save it; repeat it if lost or invalid."""
        flight = f"flight {index:03d}, seed {seed}"
        notes: list[str] = []
        while True:
            try:
                flown = self._fly(index, seed, notes)
            except process_pair.LostError as error:
                # The next attempt starts two new processes.
                self._dismiss()
                notes.append(f"{FLOWN_AGAIN}{error.what}")
                if len(notes) == MAX_ATTEMPTS:
                    raise RehearsalError(
                        f"{flight}: lost {MAX_ATTEMPTS} times; at last {error}"
                    ) from None
                self._observer.lost(f"{flight} begins again: {error}")
                continue
            faults = "; ".join(flown.record.invalid)
            # Do not repeat flights that the user changed on purpose.
            by_hand = BY_HAND in flown.record.invalid
            if not faults or by_hand or len(notes) + 1 == MAX_ATTEMPTS:
                break
            notes.append(f"{FLOWN_AGAIN}invalid: {faults}")
            self._observer.lost(f"{flight} is invalid and begins again: {faults}")
        self._folder.save_episodes([flown])
        self._clear(index)
        self._observer.finished(flown.record)

    def _present(self) -> process_pair.ProcessPair:
        """Return the two processes, and start them if needed."""
        if self._pair is None:
            # Stored before the start, so that an interrupt still ends it.
            self._pair = pair = process_pair.ProcessPair()
            self._observer.waiting("starting firmware and companion")
            log = (self._folder.path / run_folder.FIRMWARE_PRINTS).absolute()
            begin = channel.Begin(scenario=self._scenario, log=str(log), view=self._view)
            pair.start(
                begin, self._folder.path, self._keeps, lambda: self._observer.waiting(COMPILING)
            )
        return self._pair

    def _dismiss(self) -> None:
        pair, self._pair = self._pair, None
        if pair is not None:
            self._observer.waiting("ending firmware and companion")
            pair.stop()

    # --- one episode

    def _left_by(self, index: int) -> tuple[Path, Path]:
        """Return the paths of the firmware's and the companion's files of an episode."""
        folder = self._folder.path
        return folder / f".episode-{index:03d}.npz", folder / f".decisions-{index:03d}.npz"

    def _clear(self, index: int) -> None:
        for path in self._left_by(index):
            path.unlink(missing_ok=True)

    def _fly(self, index: int, seed: int, notes: Sequence[str]) -> run_folder.FlownEpisode:
        """Fly an episode. Raises LostError if it fails."""
        pair, scenario, folder = self._present(), self._scenario, self._folder
        record_path, decisions_path = self._left_by(index)
        self._clear(index)
        pair.send(
            process_pair.FIRMWARE,
            channel.LoadEpisode(
                seed=seed,
                tlog=str(folder.tlog_path(index).absolute()),
                record=str(record_path.absolute()),
            ),
        )
        known = list(notes)
        loaded = pair.wait_for(
            channel.Loaded,
            lambda event: self._look(event, known),
            load_timeout_s(scenario.scenario),
        )
        attached = behind_us(scenario.scenario) > 0
        if loaded.poses != self._poses:
            self._poses = loaded.poses
            self._observer.poses(loaded.poses)
        referee = Referee(scenario.task(loaded.goal))
        supervisor = EpisodeSupervisor(referee, loaded.time_us, lands=attached)
        faults = process_pair.ProcessFaults(pair, self._speed)
        episode = RunningEpisode(index, seed, loaded, supervisor, WallClock(), faults, known)
        self._observer.episode(index, seed, loaded.goal)
        pair.send(
            process_pair.COMPANION,
            channel.Fly(
                goal=loaded.local_goal,
                epoch_ns=loaded.epoch_ns,
                seed=seed,
                record=str(decisions_path.absolute()),
            ),
        )
        try:
            pair.pump(
                lambda _, event: self._follow(pair, episode, event) or self._over_alone(episode),
                self._longest_s(),
                "the flight",
            )
            self._call_back(pair, episode)
        except process_pair.LostError as error:
            if not pair.lives(process_pair.FIRMWARE):
                raise
            # The firmware still flies. End the companion and its setpoints, and watch the failsafe.
            faults.undo()
            pair.stop_one(process_pair.COMPANION)
            seen = self._watch_failsafe(pair, episode)
            raise process_pair.LostError("; ".join((error.what, *seen)), error.detail) from None
        if (reason := episode.separated) is not None and not disturbing(scenario.scenario.faults):
            raise process_pair.LostError(f"{SEPARATED_BY} ({reason})")
        self._observer.waiting("saving the flight")
        if pair.lives(process_pair.FIRMWARE):
            pair.send(process_pair.FIRMWARE, channel.FinishEpisode())
            pair.wait_for(channel.Saved, lambda event: self._look(event, episode.notes))
        flown = join_episode(episode, scenario, record_path, decisions_path)
        if not (pair.lives(process_pair.FIRMWARE) and pair.lives(process_pair.COMPANION)):
            self._dismiss()
        if reason is not None and not disturbances(flown.record.faults):
            raise process_pair.LostError(f"{SEPARATED_BY} ({reason})")
        return flown

    def _longest_s(self) -> float:
        """Return the maximum duration of a flight [wall s]."""
        asked = self._scenario.scenario
        stands_s = sum(
            fault.for_s or 0.0 for fault in asked.faults if fault.part == process_pair.FIRMWARE
        )
        flown_s = TAKEOFF_LIMIT_S + asked.time_limit_s + WRAP_UP_S
        return (flown_s + stands_s) / self._speed

    def _call_back(self, pair: process_pair.ProcessPair, episode: RunningEpisode) -> None:
        """Resume suspended processes; an aborted companion reports its log."""
        episode.faults.undo()
        if episode.ended is None and pair.lives(process_pair.COMPANION):
            pair.send(process_pair.COMPANION, channel.Abort(land=False))
            try:
                pair.pump(
                    lambda _, event: self._follow(pair, episode, event),
                    process_pair.REPLY_TIMEOUT_S,
                    "its end",
                )
            except process_pair.LostError:
                # The companion was to be aborted anyway: its decision log is lost.
                pair.stop_one(process_pair.COMPANION)

    def _follow(
        self, pair: process_pair.ProcessPair, episode: RunningEpisode, event: channel.Event
    ) -> bool:
        """Handle one event of a flight; return True when the companion has ended it."""
        referee = episode.referee
        if isinstance(event, channel.State):
            self._see(pair, episode, event)
        elif isinstance(event, channel.LogLost):
            episode.notes.append(event.what)
        elif isinstance(event, channel.Due):
            self._carry_out(episode, event)
        elif isinstance(event, channel.PhaseEntered):
            self._observer.phase(event.phase, event.time_us)
            if event.phase == "navigating":
                episode.navigating_us = event.time_us
                referee.start_navigation(event.time_us - episode.slipped_us)
        elif isinstance(event, channel.Text):
            self._observer.text(event)
            if episode.faults.out(process_pair.COMPANION) and event.severity <= WARNING:
                episode.notes.append(_said(event))
        elif isinstance(event, channel.Ended):
            episode.ended = event
            episode.notes.extend(event.notes)
            self._end(episode, episode.faults.reason or event.reason)
            return True
        return False

    def _end(self, episode: RunningEpisode, reason: str) -> None:
        """Abort a flight without a verdict."""
        if episode.referee.verdict is None:
            now_us = episode.state.time_us if episode.state else episode.loaded.time_us
            self._judge(episode, episode.referee.abort(now_us, reason))

    def _carry_out(self, episode: RunningEpisode, due: channel.Due) -> None:
        """Suspend, kill or resume a process for a due fault."""
        faults = episode.faults
        if (done := faults.carry_out(due)) is not None:
            episode.notes.append(done)
        if faults.out(process_pair.FIRMWARE) == process_pair.KILLED and faults.reason is not None:
            self._end(episode, faults.reason)

    def _over_alone(self, episode: RunningEpisode) -> bool:
        """Return True if a flight without a companion is over: judged, or landed."""
        faults, state = episode.faults, episode.state
        if not faults.out(process_pair.COMPANION) or faults.reason is None:
            return False
        if state is not None and not state.armed:
            self._end(episode, faults.reason)
        return episode.referee.verdict is not None

    def _see(
        self, pair: process_pair.ProcessPair, episode: RunningEpisode, state: channel.State
    ) -> None:
        episode.state = state
        self._observer.state(state, episode.loaded.time_us)
        judged = episode.referee.verdict is not None
        order = episode.supervisor.see(
            TruthSample(state.time_us, state.position, state.collision, state.battery)
        )
        verdict = episode.referee.verdict
        if verdict is not None and not judged:
            self._judge(episode, verdict)
        if order is not None:
            pair.send(process_pair.COMPANION, channel.Abort(land=order is Order.LAND))

    def _judge(self, episode: RunningEpisode, verdict: Verdict) -> None:
        if episode.wall_us is None:
            episode.wall_us = episode.stopwatch.time_us()
            episode.paused_us = episode.faults.paused_us
            episode.verdict_state = episode.state
        self._observer.phase(verdict.outcome.value, verdict.time_us)

    def _watch_failsafe(self, pair: process_pair.ProcessPair, episode: RunningEpisode) -> list[str]:
        """Watch the flight controller without its companion until disarmed; return its texts."""
        self._observer.waiting("companion lost: watching the failsafe land the vehicle")
        said: list[str] = []

        def down(_name: str, event: channel.Event) -> bool:
            if isinstance(event, channel.Text):
                self._observer.text(event)
                said.append(_said(event))
            if isinstance(event, channel.State):
                self._observer.state(event, episode.loaded.time_us)
                return not event.armed
            return False

        try:
            pair.pump(down, WRAP_UP_S / self._speed, "the vehicle to come down")
        except process_pair.LostError as error:
            said.append(error.what)
        return said

    def _look(self, event: channel.Event, notes: list[str]) -> None:
        """Handle an event outside a wait; add texts for the record to `notes`."""
        if isinstance(event, channel.Text):
            self._observer.text(event)
        elif isinstance(event, channel.LogLost):
            notes.append(event.what)


def _said(text: channel.Text) -> str:
    return f"autopilot at {text.time_us / US_PER_S:.2f} s: {text.text}"
