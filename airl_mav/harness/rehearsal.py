"""A rehearsal: two processes, N seeded episodes, one run folder."""

from __future__ import annotations

import queue
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from airl_mav.channel import (
    Abort,
    Ended,
    Event,
    Failed,
    FinishEpisode,
    Fly,
    Loaded,
    LoadEpisode,
    Progress,
    Ready,
    Saved,
    State,
    Text,
)
from airl_mav.clock import WallClock
from airl_mav.constants import US_PER_S
from airl_mav.errors import UsageError
from airl_mav.flight.judge import Referee, Task, TruthSample, Verdict
from airl_mav.flight.record import EpisodeRecord
from airl_mav.harness.episode import Episode, Plan, save_episode
from airl_mav.harness.following import TAKEOFF_LIMIT_S, Follower, Order
from airl_mav.harness.process import Child, Exited
from airl_mav.harness.run_folder import RunFolder

FIRMWARE, COMPANION = "firmware", "companion"

READY_TIMEOUT_S = 180.0
"""The first start after an install compiles the kernels [wall s]."""

REPLY_TIMEOUT_S = 30.0
"""Longest wait for an answer of a healthy process [wall s]."""

WRAP_UP_S = 90.0
"""Longest time from the verdict to the companion's report: landing included [simulated s]."""


class RehearsalError(Exception):
    """The run cannot go on; the message says why."""


class Observer(Protocol):
    """Whoever shows the progress. All calls come from one thread."""

    def waiting(self, what: str) -> None:
        """Something is being waited for."""
        ...

    def episode(self, index: int, seed: int, goal: tuple[float, float]) -> None:
        """An episode begins."""
        ...

    def phase(self, phase: str, time_us: int) -> None:
        """The companion has entered a phase."""
        ...

    def state(self, state: State, started_us: int) -> None:
        """The vehicle's true state."""
        ...

    def text(self, text: Text) -> None:
        """The autopilot said something."""
        ...

    def finished(self, record: EpisodeRecord) -> None:
        """An episode has been saved."""
        ...


class Rehearsal:
    """Runs a plan. Use as a context manager: whatever happens, both processes end."""

    def __init__(self, plan: Plan, folder: RunFolder, observer: Observer) -> None:
        self._plan = plan
        self._folder = folder
        self._observer = observer
        self._events: queue.Queue[tuple[str, Event | Exited]] = queue.Queue()
        self._children: dict[str, Child] = {}

    def __enter__(self) -> Rehearsal:
        """Start both processes and wait until they are ready.

        Raises:
            UsageError: A process says that its input cannot be used.
            RehearsalError: A process died or did not become ready in time.
        """
        try:
            for name, plan in ((FIRMWARE, self._plan.firmware), (COMPANION, self._plan.companion)):
                log = self._folder.path / f"{name}.log"
                self._children[name] = Child(name, plan.module, plan.arguments, log, self._events)
            self._observer.waiting("starting firmware and companion")
            ready: set[str] = set()

            def note(name: str, event: Event) -> bool:
                if isinstance(event, Ready):
                    ready.add(name)
                if isinstance(event, Failed):
                    raise UsageError(event.message)
                return len(ready) == len(self._children)

            self._pump(note, READY_TIMEOUT_S, "both processes to be ready")
        except BaseException:
            self._stop_children()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End both processes."""
        self._stop_children()

    def _stop_children(self) -> None:
        try:
            # The companion first: what it commands last is part of the flight.
            for name in (COMPANION, FIRMWARE):
                if name in self._children:
                    self._children[name].stop()
        except BaseException:
            # A second Ctrl-C: no more patience, but nobody is left behind.
            for child in self._children.values():
                child.kill()
            raise

    def run(self) -> None:
        """Fly all episodes; each is saved as it ends.

        Raises:
            RehearsalError: A process died. The running episode is saved as aborted, unless it was
                the firmware, which holds its data.
        """
        for index in range(self._plan.episodes):
            self._fly(index)

    # --- one episode

    def _fly(self, index: int) -> None:
        plan, folder = self._plan, self._folder
        seed = plan.seed + index
        record_path = folder.path / f".episode-{index:03d}.npz"
        decisions_path = folder.path / f".decisions-{index:03d}.npz"
        self._children[FIRMWARE].send(
            LoadEpisode(
                episode=index,
                arena=plan.arena,
                arena_seed=plan.arena_seed_of(seed),
                seed=seed,
                tlog=str(folder.tlog_path(index).absolute()),
                record=str(record_path.absolute()),
            )
        )
        loaded = self._wait_for(Loaded, REPLY_TIMEOUT_S)
        task = Task(loaded.goal, plan.goal_radius_m, plan.time_limit_s)
        follower = Follower(Referee(task), loaded.time_us)
        episode = Episode(index, seed, loaded, follower, WallClock())
        self._observer.episode(index, seed, loaded.goal)
        self._children[COMPANION].send(
            Fly(
                episode=index,
                goal=loaded.goal,
                epoch_ns=loaded.epoch_ns,
                latency_seed=seed,
                record=str(decisions_path.absolute()),
            )
        )
        limit_s = (TAKEOFF_LIMIT_S + plan.time_limit_s + WRAP_UP_S) / plan.speed
        broken: RehearsalError | None = None
        try:
            self._pump(
                lambda name, event: self._follow(episode, name, event), limit_s, "the flight"
            )
        except RehearsalError as error:
            broken = error
            now_us = episode.state.time_us if episode.state is not None else loaded.time_us
            self._judge(episode, episode.referee.abort(now_us, str(error)))
            if not self._firmware_lives():
                raise
            # The firmware still flies. Whatever is wrong with the companion, its setpoints end
            # here; see the failsafe through, then keep the data.
            self._children[COMPANION].stop()
            self._watch_failsafe(episode)
            if not self._firmware_lives():
                raise
        self._children[FIRMWARE].send(FinishEpisode())
        self._wait_for(Saved, REPLY_TIMEOUT_S)
        self._save(episode, record_path, decisions_path)
        if broken is not None:
            raise broken

    def _follow(self, episode: Episode, _name: str, event: Event) -> bool:
        """Take one event of a flight; True when it is over."""
        referee = episode.referee
        if isinstance(event, State):
            self._see(episode, event)
        elif isinstance(event, Progress):
            self._observer.phase(event.phase, event.time_us)
            if event.phase == "navigating":
                # By the companion's clock, which has not given up what the simulator's has.
                referee.start_navigation(event.time_us - episode.slipped_us)
        elif isinstance(event, Text):
            self._observer.text(event)
        elif isinstance(event, Ended):
            episode.ended = event
            episode.notes.extend(event.notes)
            if referee.verdict is None:
                now_us = episode.state.time_us if episode.state else episode.loaded.time_us
                self._judge(episode, referee.abort(now_us, event.reason))
            return True
        return False

    def _see(self, episode: Episode, state: State) -> None:
        episode.state = state
        self._observer.state(state, episode.loaded.time_us)
        judged = episode.referee.verdict is not None
        order = episode.follower.see(
            TruthSample(state.time_us, state.position, state.collision, state.battery)
        )
        verdict = episode.referee.verdict
        if verdict is not None and not judged:
            self._judge(episode, verdict)
        if order is not None:
            self._children[COMPANION].send(Abort(land=order is Order.LAND))

    def _judge(self, episode: Episode, verdict: Verdict) -> None:
        if episode.wall_us is None:
            episode.wall_us = episode.stopwatch.time_us()
            episode.verdict_state = episode.state
        self._observer.phase(verdict.outcome.value, verdict.time_us)

    def _watch_failsafe(self, episode: Episode) -> None:
        """The companion is gone: watch what the flight controller does, until it is down."""
        self._observer.waiting("companion lost: watching the failsafe land the vehicle")

        def down(_name: str, event: Event) -> bool:
            if isinstance(event, Text):
                self._observer.text(event)
                episode.notes.append(f"autopilot at {event.time_us / US_PER_S:.2f} s: {event.text}")
            if isinstance(event, State):
                episode.state = event
                self._observer.state(event, episode.loaded.time_us)
                return not event.armed
            return False

        try:
            self._pump(down, WRAP_UP_S / self._plan.speed, "the vehicle to come down")
        except RehearsalError as error:
            episode.notes.append(str(error))

    def _save(self, episode: Episode, record_path: Path, decisions_path: Path) -> None:
        record = save_episode(episode, self._plan, self._folder, record_path, decisions_path)
        self._observer.finished(record)

    # --- events

    def _firmware_lives(self) -> bool:
        return not self._children[FIRMWARE].ending

    def _wait_for(self, kind: type[Any], timeout_s: float) -> Any:
        found: list[Any] = []

        def look(_name: str, event: Event) -> bool:
            if isinstance(event, Text):
                self._observer.text(event)
            if isinstance(event, kind):
                found.append(event)
            return bool(found)

        self._pump(look, timeout_s, f"the event {kind.__name__!r}")
        return found[0]

    def _pump(self, take: Callable[[str, Event], bool], timeout_s: float, what: str) -> None:
        """Feed events to `take` until it returns True.

        Raises:
            RehearsalError: A process died or failed, or the time is over.
        """
        deadline = WallClock()
        while True:
            left_s = timeout_s - deadline.time_us() / US_PER_S
            if left_s <= 0.0:
                raise RehearsalError(f"gave up waiting for {what} after {timeout_s:.0f} s")
            try:
                # Short waits, so that Ctrl-C is seen at once on every platform.
                name, event = self._events.get(timeout=min(left_s, 0.2))
            except queue.Empty:
                continue
            if isinstance(event, Exited):
                self._died(name, event)
            elif take(name, event):
                return
            elif isinstance(event, Failed):
                self._children[name].ending = True
                raise RehearsalError(f"{name}: {event.message}")

    def _died(self, name: str, exited: Exited) -> None:
        child = self._children[name]
        if child.ending:
            return
        child.ending = True
        tail = child.log_tail()
        detail = f"\n{tail}" if tail else ""
        raise RehearsalError(f"the {name} process died: {exited} (log: {child.log}){detail}")
