"""Live view of a training: replays the newest episode of its first vehicle.

Training only records that vehicle's seeds and actions. Flights are independent of other vehicles,
so a separate thread repeats them at the viewers' pace, skipping some. Learning is not affected.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.view import view_messages, viewer
from airl_mav.addons.view.view_messages import OFFBOARD, ViewSettings
from airl_mav.camera.frame import MM_PER_M
from airl_mav.core.constants import US_PER_S
from airl_mav.envs.evaluation import Trace
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.flight.trajectory import Trajectory
from airl_mav.latency.stamps import NO_STAMP, SETPOINTS
from airl_mav.policy.actions import commands, discrete_actions
from airl_mav.policy.layouts import Encoded, newest_frame
from airl_mav.rehearsal.live_view import ViewAddresses
from airl_mav.training.training_folder import Evaluation, TrainingProgress

SPEED = 2.0
"""Default replay speed; viewers can change it [simulated s per wall s]."""

SAMPLES = 2
"""Decimation of the trace's samples, which are 20 ms apart."""

END_US = 1_000_000
"""Display time of the end of a flight [simulated µs]."""

REST_S = 0.01
"""Minimum time between two replayed decisions [wall s], at any speed."""

LOOK_S = 0.1
"""Polling period for a new flight [wall s]."""

INFO = 6


def request_of(name: str, port: int | None = None) -> ViewSettings:
    """Return the request for the view of a training; `name` is the configuration's name."""
    return ViewSettings(
        run=f"{name}, training",
        port=port,
        paced=True,
        speed=SPEED,
        steerable=False,
        compensable=False,
        compensated=False,
    )


@dataclass
class Taped:
    """A recorded episode of the first vehicle."""

    number: int
    """Number of the episode, from 0 on."""
    seed: int
    zone: int | None
    actions: list[NDArray[Any]] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    outcome: str = ""
    """Outcome; empty while the episode is running."""


class TimedMessage(NamedTuple):
    """Message to show at a time of a flight [simulated µs since its start]."""

    time_us: int
    message: view_messages.ViewMessage
    image: view_messages.Image | None = None


class _Standing(NamedTuple):
    """Progress of the training."""

    steps: int = 0
    success: float | None = None
    zone: int | None = None


class WatchedTraining(TrainingProgress):
    """Adapter from a training to a view. An `envs.sb3.Watcher`, and a `TrainingProgress`."""

    def __init__(
        self, ends: ViewAddresses, environment: EnvironmentSpec, onwards: TrainingProgress
    ) -> None:
        """Connect to a view of training in `environment`; `onwards` also receives the progress."""
        self._onwards = onwards
        self._environment = environment
        self._taping: Taped | None = None
        self._count = 0
        self._standing = _Standing()
        self._newest: deque[Taped] = deque(maxlen=1)
        self._said: deque[view_messages.Said] = deque(maxlen=16)
        self._feed, self._pace = viewer.Feed(ends), viewer.Pace(ends, SPEED)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watched training", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the replay, and disconnect."""
        self._ended.set()
        self._pace.let_go()
        self._thread.join()

    # --- the training's side

    def begun(self) -> None:
        """Called when all episodes begin."""
        self._tape_next()

    def decided(
        self, seed: int, zone: int, action: NDArray[Any], reward: float, outcome: str | None
    ) -> None:
        """Record a decision of the first vehicle; see `envs.sb3.Watcher`."""
        taping = self._taping
        if taping is not None:
            if not taping.actions:
                taping.seed, taping.zone = seed, None if zone < 0 else zone
            taping.actions.append(np.array(action))
            taping.rewards.append(reward)
        if outcome is not None:
            if taping is not None:
                taping.outcome = outcome
                self._newest.append(taping)
            self._tape_next()

    def _tape_next(self) -> None:
        self._taping = Taped(self._count, 0, None)
        self._count += 1

    def waiting(self, why: str) -> None:
        """Forward the reason for waiting."""
        self._onwards.waiting(why)

    def trained(self, steps: int, success: float | None, zone: int | None) -> None:
        """Store the progress of the training."""
        self._standing = _Standing(steps, success, zone)
        self._onwards.trained(steps, success, zone)

    def evaluated(self, evaluation: Evaluation, *, best: bool) -> None:
        """Report an evaluation."""
        so_far = ", the best so far" if best else ""
        text = f"evaluation after {evaluation.steps:,} decisions: {evaluation.success_rate:.1%}"
        text += f" of {evaluation.episodes} reach the goal{so_far}"
        self._said.append(view_messages.Said(time_us=None, severity=INFO, text=text))
        self._onwards.evaluated(evaluation, best=best)

    # --- the view's side, in a thread

    def _run(self) -> None:
        replay, shown_us = EpisodeReplay(self._environment), 0
        while not self._ended.is_set():
            if self._newest:
                shown_us = self._show(replay, self._newest.pop(), shown_us)
            else:
                self._ended.wait(LOOK_S)
        self._pace.close()
        self._feed.close()

    def _show(self, replay: EpisodeReplay, taped: Taped, began_us: int) -> int:
        """Show a flight that begins at a time of the view [µs]; return the time of its end."""
        now_us = began_us
        for moment in replay.moments(taped, began_us):
            now_us = began_us + moment.time_us
            self._pace.tick(now_us)
            if self._ended.is_set():
                return now_us
            message = moment.message
            if isinstance(message, view_messages.Trained):
                steps, success, zone = self._standing
                message = message.model_copy(
                    update={"steps": steps, "success": success, "zone": zone}
                )
            self._feed.send(message, moment.image)
            if isinstance(message, view_messages.Decided):
                self._pace.decided()
                while self._said:
                    self._feed.send(self._said.popleft())
                self._ended.wait(REST_S)
        self._pace.tick(now_us + END_US)
        return now_us + END_US


class EpisodeReplay:
    """Replay of episodes, decision by decision, with all messages of a view."""

    def __init__(self, environment: EnvironmentSpec) -> None:
        """Prepare a vehicle of the environment."""
        self._trace = Trace(1, environment.action_spec.commands)
        self.navigation = Navigation(environment, 1, trace=self._trace)
        self._environment = environment

    def moments(self, taped: Taped, began_us: int) -> Iterator[TimedMessage]:
        """Replay a recorded episode; yield moments by time, with messages offset by `began_us`."""
        navigation, trace = self.navigation, self._trace
        navigation.begin([0], [taped.seed], taped.zone)
        yield from self._beginning(taped, began_us)
        yield self._picture(began_us)
        seen, shown, decisions = navigation.observe(), 0, len(taped.actions)
        for k in range(decisions):
            image = self._as_seen({key: array[0] for key, array in seen.items()})
            chosen = commands(self._environment.action_spec, taped.actions[k][None])
            navigation.fly(chosen)
            yield self._decided(image, began_us)
            yield self._trained(taped, k, began_us)
            flown = trace.trajectory(0)
            last = len(flown.time_us) - 1
            for row in range(shown, last + 1):
                if row % SAMPLES == 0 or (row == last and k == decisions - 1):
                    yield self._vehicle(flown, row, began_us)
            shown = last + 1
            seen = navigation.observe()
            yield self._picture(began_us)
        yield from self._ending(taped, began_us)

    def _now_us(self) -> int:
        return int(self.navigation.whole_truth().fleet.time_us[0])

    def _beginning(self, taped: Taped, began_us: int) -> list[TimedMessage]:
        arena, seed = self.navigation.arenas[0], taped.seed
        assert arena is not None  # noqa: S101 - its episode has begun
        goal = arena.goal_point
        episode = view_messages.Episode(
            seed=seed,
            started_us=began_us,
            arena=arena,
            vehicle=view_messages.VehicleShape.of(self.navigation.vehicle),
            goal=goal,
            goal_radius_m=self._environment.episode.goal_radius_m,
        )
        return [
            TimedMessage(0, view_messages.Flight(index=taped.number, seed=seed, goal=goal)),
            TimedMessage(0, episode),
            TimedMessage(0, view_messages.PhaseStart(time_us=began_us, phase="navigating")),
        ]

    def _picture(self, began_us: int) -> TimedMessage:
        image = self.navigation.cameras.image[0].copy()
        now_us, shape = self._now_us(), view_messages.shape_of(image)
        taken = view_messages.CameraImage(captured_us=began_us + now_us, shape=shape)
        return TimedMessage(now_us, taken, image)

    def _as_seen(self, seen: Encoded) -> view_messages.Image:
        """Return the network's image for the view: depth [mm], or colours."""
        spec = self.navigation.observation
        image = newest_frame(spec, seen)
        if spec.kind != "depth":
            return image if image.ndim == 3 else image[..., None]
        far_mm = spec.range_m * MM_PER_M
        # 0 would mean "no return".
        depth: view_messages.Image = np.maximum(np.rint(image * (far_mm / 255.0)), 1.0).astype(
            np.uint16
        )
        return depth

    def _decided(self, image: view_messages.Image, began_us: int) -> TimedMessage:
        """Return the newest decision, at its start time."""
        record = self._trace.latency(0)
        stamp = {name: int(column[-1]) for name, column in record.items() if column.ndim == 1}
        began = stamp["infer_start_us"]
        ready, sent = (
            began if stamp[name] == NO_STAMP else stamp[name]
            for name in ("action_ready_us", "sent_us")
        )
        episode, expires_us = self._environment.episode, None
        if episode.hover_after_s is not None:
            held_s = episode.hold_s + episode.hover_after_s
            expires_us = began_us + sent + round(held_s * US_PER_S)
        commands = self._environment.action_spec.commands
        message = view_messages.Decided(
            captured_us=began_us + stamp["capture_us"],
            began_us=began_us + began,
            ready_us=began_us + ready,
            sent_us=began_us + sent,
            expires_us=expires_us,
            setpoint=tuple(record[SETPOINTS[commands]][-1].tolist()),
            commands=commands,
            compensated=self._environment.compensate,
            shape=view_messages.shape_of(image),
        )
        return TimedMessage(began, message, image)

    def _trained(self, taped: Taped, k: int, began_us: int) -> TimedMessage:
        """Return action and reward of decision k; the training's progress is unknown here."""
        began = int(self._trace.latency(0)["infer_start_us"][-1])
        action, count = taped.actions[k], discrete_actions(self._environment.action_spec)
        if count is None:
            text = ", ".join(f"{number:+.2f}" for number in np.ravel(action).tolist())
        else:
            text = f"{int(action)} of 0 to {count - 1}"
        message = view_messages.Trained(
            time_us=began_us + began,
            action=text,
            reward=taped.rewards[k],
            returned=sum(taped.rewards[: k + 1]),
        )
        return TimedMessage(began, message)

    def _vehicle(self, flown: Trajectory, row: int, began_us: int) -> TimedMessage:
        """Return the vehicle at a sample; rotors and battery are from the end of the decision."""
        fleet, time_us = self.navigation.whole_truth().fleet, int(flown.time_us[row])
        state = view_messages.VehicleState(
            time_us=began_us + time_us,
            position=tuple(flown.position[row].tolist()),
            velocity=tuple(flown.velocity[row].tolist()),
            quaternion=tuple(flown.quaternion[row].tolist()),
            rotors=tuple(fleet.rotor[0].tolist()),
            battery=float(fleet.battery[0]),
            mode=OFFBOARD,
            armed=True,
            collision=None,
        )
        return TimedMessage(time_us, state)

    def _ending(self, taped: Taped, began_us: int) -> list[TimedMessage]:
        now_us = self._now_us()
        text = f"episode {taped.number}: {taped.outcome} after {now_us / US_PER_S:.1f} s, return"
        said, then_us = f"{text} {sum(taped.rewards):+.3f}", began_us + now_us
        ended = view_messages.PhaseStart(time_us=then_us, phase=taped.outcome)
        told = view_messages.Said(time_us=then_us, severity=INFO, text=said)
        return [TimedMessage(now_us, ended), TimedMessage(now_us, told)]
