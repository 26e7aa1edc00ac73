"""Evaluation of a policy in seeded episodes, and records of its flights.

Also for model selection. `Trace` records a flight's path at 50 Hz and the timestamps of its
decisions. The files have the format of a rehearsal (docs/reference/run-folder.md), so all levels
use the same report.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.core import constants, errors
from airl_mav.envs.fleet import Fleet, FlightStatus
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.flight.judge import Outcome
from airl_mav.flight.trajectory import SAMPLE_US, Trajectory
from airl_mav.latency.stamps import NO_STAMP, SETPOINTS
from airl_mav.policy.actions import Action, Policy, command_numbers, commands, failure_of, flyable
from airl_mav.policy.layouts import Encoded, boxes, encode_layout, layout_of
from airl_mav.policy.observation import Observation
from airl_mav.policy.registry import LearnedPolicy

Decide = Callable[[Encoded], NDArray[Any]]
"""Function from observations of n vehicles to n actions; must treat each row independently."""

SLOTS = 256
"""Default number of parallel flights."""

OUTCOMES = {
    FlightStatus.SUCCESS: Outcome.SUCCESS,
    FlightStatus.COLLISION: Outcome.COLLISION,
    FlightStatus.BATTERY: Outcome.BATTERY,
    FlightStatus.TIMEOUT: Outcome.TIMEOUT,
    FlightStatus.ABORTED: Outcome.ABORTED,
}
"""Recorded outcome of each verdict of the vectorized simulator."""


@dataclass(frozen=True)
class EpisodeResult:
    """Result of one episode."""

    seed: int
    verdict: FlightStatus
    flight_time_s: float
    distance_m: float
    energy_j: float
    decisions: int
    reward: float
    """Sum of a built-in reward, without costs; 0 for a custom one."""
    failure: str = ""
    """Reason of an aborted flight: the policy's error."""


class Pilots(Protocol):
    """Interface of pilots: decide for n vehicles, independently of each other."""

    @property
    def failed(self) -> Mapping[int, str]:
        """Failures of the last `decide` by slot: these flights are aborted."""

    def begin(self, slot: int, seed: int) -> None:
        """Start an episode in a slot."""

    def decide(self, seen: Observation, flying: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the velocity commands (n, 3) or (n, 4) for `Navigation.fly`.

        Args:
            seen: The observations of n vehicles.
            flying: (n,) vehicles that execute their command.
        """


class LearnedPilots:
    """Pilot with a network, for all vehicles in one batch or one by one as required."""

    def __init__(self, policy: LearnedPolicy, chance: Callable[[int], np.random.Generator]) -> None:
        """Store the policy; `chance` returns the generator of random actions for a seed."""
        self._policy = policy
        self._chance = chance
        # Random actions must be independent of other rows, and memory must be bit-identical to the
        # companion's, which a batch of n rows does not guarantee.
        self._remembers = layout_of(policy.card.observation.layout).remembers
        self._alone = bool(policy.card.epsilon or policy.card.state or self._remembers)
        self._own: dict[int, LearnedPolicy] = {}
        self.encoded: Encoded = {}
        """Inputs of the last `decide`."""
        self.failed: dict[int, str] = {}

    def begin(self, slot: int, seed: int) -> None:
        """Start an episode with a new random generator and empty memory."""
        if self._alone:
            self._own[slot] = self._policy.with_generator(self._chance(seed))

    def decide(self, seen: Observation, flying: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the commands; see `Pilots`."""
        card = self._policy.card
        encoded = self.encoded = self._encode(seen, flying)
        self.failed = {}
        if not self._alone:
            with suppress(Exception):  # Of some rows, which are found below.
                return commands(card.actions, self._policy.act_batch(encoded))

        def act(i: int) -> Any:
            # One row at a time, so that a row's result does not depend on the others.
            if self._alone:
                row = {key: array[i : i + 1] for key, array in encoded.items()}
                return commands(card.actions, self._own[i].act_batch(row))[0]
            # In a batch of the same size: another size may give other bits.
            same = {key: np.repeat(a[i : i + 1], len(a), 0) for key, a in encoded.items()}
            return commands(card.actions, self._policy.act_batch(same))[i]

        chosen = np.zeros((len(flying), command_numbers(card.actions)))
        self.failed = _each(flying, act, chosen)
        return chosen

    def _encode(self, seen: Observation, flying: NDArray[np.bool_]) -> Encoded:
        """Return the inputs of n vehicles; with a memory zeros for those that do not fly."""
        if not self._remembers:
            return self._policy.encode(seen)
        found = {
            key: np.zeros((len(flying), *box.shape), box.dtype)
            for key, box in boxes(self._policy.card.observation).items()
        }
        for i in np.flatnonzero(flying).tolist():
            for key, array in self._own[i].encode(seen.rows([i])).items():
                found[key][i] = array[0]
        return found


def _each(
    flying: NDArray[np.bool_], act: Callable[[int], Any], chosen: NDArray[np.float64]
) -> dict[int, str]:
    """Store the command of each flying vehicle; return the failures of policies by vehicle."""
    failed = {}
    for i in np.flatnonzero(flying).tolist():
        try:
            chosen[i] = act(i)
        except errors.UsageError:
            raise
        except Exception as error:  # A policy may raise any exception.
            failed[i] = failure_of(error)
    return failed


class SinglePilots:
    """Pilot with one policy object per vehicle and episode, for policies with memory."""

    def __init__(
        self,
        make: Callable[[], Policy],
        max_speed_m_s: float,
        commands: constants.CommandKind = "velocity",
    ) -> None:
        """Store the policy factory, the speed limit of its actions [m/s], and the command kind."""
        self._make = make
        self._max_speed_m_s = max_speed_m_s
        self._commands: constants.CommandKind = commands
        self._policies: dict[int, Policy] = {}
        self.failed: dict[int, str] = {}

    def begin(self, slot: int, seed: int) -> None:  # noqa: ARG002
        """Create the episode's policy."""
        self._policies[slot] = self._make()

    def decide(self, seen: Observation, flying: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the commands; see `Pilots`."""
        # NaN in the last column is altitude hold.
        chosen = np.tile((0.0, 0.0, 0.0, math.nan), (len(flying), 1))

        def act(i: int) -> tuple[float, ...]:
            asked = self._policies[i].act(seen.rows(i))
            action = flyable(asked, self._commands, self._max_speed_m_s)
            if not isinstance(action, Action):
                return action
            down = math.nan if action.down_m_s is None else action.down_m_s
            return action.forward_m_s, action.right_m_s, action.yaw_rate_rad_s, down

        self.failed = _each(flying, act, chosen)
        # Without any vertical speed the commands have three columns.
        return chosen[:, :3] if np.isnan(chosen[:, 3]).all() else chosen


class _EncodedPilots:
    """Pilot that calls a plain function with the environment's encoding."""

    def __init__(
        self, navigation: Navigation, decide: Decide, began: Callable[[int], None] | None
    ) -> None:
        self._navigation = navigation
        self._decide = decide
        self._began = began
        self.failed: dict[int, str] = {}

    def begin(self, slot: int, seed: int) -> None:  # noqa: ARG002
        """Call the `began` callback, if any."""
        if self._began is not None:
            self._began(slot)

    def decide(self, seen: Observation, flying: NDArray[np.bool_]) -> NDArray[np.float64]:  # noqa: ARG002
        """Return the commands; see `Pilots`."""
        encoded = encode_layout(self._navigation.observation, seen)
        return commands(self._navigation.spec.action_spec, self._decide(encoded))


def fly_episodes(
    spec: EnvironmentSpec,
    decide: Decide,
    seeds: Sequence[int],
    *,
    slots: int = SLOTS,
    zone: int | None = None,
    began: Callable[[int], None] | None = None,
) -> Iterator[EpisodeResult]:
    """Fly one episode per seed and yield each result as it ends, in order of completion.

    An episode's result depends on its seed only, not on parallel flights.

    Args:
        spec: The environment.
        decide: The policy.
        seeds: Seeds of the episodes.
        slots: Number of parallel flights.
        zone: Curriculum zone that bounds the goals; None = the largest.
        began: Callback with the slot of each starting episode, for policies with memory.
    """
    if not seeds:
        return
    navigation = Navigation(spec, min(slots, len(seeds)))
    pilots = _EncodedPilots(navigation, decide, began)
    for _, flown in fly_seeds(navigation, pilots, seeds, zone=zone):
        yield flown


def fly_seeds(
    navigation: Navigation,
    pilots: Pilots,
    seeds: Sequence[int],
    *,
    zone: int | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[int, EpisodeResult]]:
    """Fly one episode per seed and yield slot and result of each as it ends.

    The slot keeps the flight's final state until the next item is requested.

    Args:
        navigation: Must not have more slots than seeds.
        pilots: Pilots of all vehicles.
        seeds: Seeds of the episodes.
        zone: Curriculum zone that bounds the goals; None = the largest.
        stop: Called before each decision; if True, iteration ends without the unfinished flights.
    """
    n = navigation.n
    waiting = list(reversed(seeds))
    decisions, paid = np.zeros(n, np.int64), np.zeros(n)
    busy = np.zeros(n, np.bool_)

    def begin(slots: Sequence[int]) -> None:
        # The list is reversed, so `pop` returns the seeds in order.
        taken = [waiting.pop() for _ in slots]
        navigation.begin(slots, taken, zone)
        for slot, seed in zip(slots, taken, strict=True):
            pilots.begin(slot, seed)
        decisions[slots], paid[slots] = 0, 0.0
        busy[slots] = True

    begin(range(n))
    while busy.any() and not stop():
        decided = pilots.decide(navigation.see(), busy)
        navigation.fleet.verdict[list(failed := pilots.failed)] = FlightStatus.ABORTED
        navigation.fly(decided)
        decisions += 1
        paid += navigation.paid
        now = navigation.flights()
        ended = np.flatnonzero(busy & (now.verdict != FlightStatus.FLYING)).tolist()
        for i in ended:
            busy[i] = False
            yield (
                i,
                EpisodeResult(
                    seed=int(navigation.seeds[i]),
                    verdict=FlightStatus(int(now.verdict[i])),
                    flight_time_s=float(now.time_s[i]),
                    distance_m=float(now.distance_m[i]),
                    energy_j=float(now.energy_j[i]),
                    decisions=int(decisions[i]),
                    reward=float(paid[i]),
                    failure=failed.get(i, ""),
                ),
            )
        # Slots restart only after all results of this decision have been consumed.
        if ended and waiting:
            begin(ended[: len(waiting)])


def success_rate(flown: Sequence[EpisodeResult]) -> float:
    """Return the share of episodes that reached the goal."""
    return sum(each.verdict == FlightStatus.SUCCESS for each in flown) / len(flown)


def mean_of_successes(flown: Iterable[EpisodeResult], quality: str) -> float | None:
    """Return the mean of a field over the episodes that reached the goal; None without one."""
    good = [getattr(each, quality) for each in flown if each.verdict == FlightStatus.SUCCESS]
    return float(np.mean(good)) if good else None


STATE = 12
"""Columns of a sample: time [µs], position, velocity, quaternion, mean power. Whole microseconds
are exact in a float64 for centuries."""

STAMPS = (
    "capture_us",
    "decoded_us",
    "infer_start_us",
    "action_ready_us",
    "sent_us",
    "motor_us",
    "held_until_us",
)
"""Timestamps of a decision, as in `latency.npz`; link and control are combined, so the time of
acceptance by the autopilot is missing."""


class _Tables:
    """Growing table for each of n slots."""

    def __init__(self, n: int, width: int, dtype: type[np.generic]) -> None:
        self._rows: NDArray[Any] = np.zeros((n, 256, width), dtype)
        self._count = np.zeros(n, np.int64)

    def clear(self, i: int) -> None:
        """Delete the rows of a slot."""
        self._count[i] = 0

    def append(self, who: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Add one row to each slot of `who` (k,); values (k, width)."""
        at = self._count[who]
        if at.size and at.max() == self._rows.shape[1]:
            # Doubling keeps the cost of growth constant per row.
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)], axis=1)
        self._rows[who, at] = values
        self._count[who] += 1

    def of(self, i: int) -> NDArray[Any]:
        """Return a copy of the rows of a slot."""
        rows: NDArray[Any] = self._rows[i, : self._count[i]].copy()
        return rows


class Trace:
    """Recorder of n flights; a slot's record is kept until its next flight starts."""

    def __init__(self, n: int, commands: constants.CommandKind = "velocity") -> None:
        """Create a recorder for policies with a command type, by default velocity."""
        self._column = SETPOINTS[commands]
        self._samples = _Tables(n, STATE, np.float64)
        self._stamps = _Tables(n, len(STAMPS), np.int64)
        self._setpoints = _Tables(n, 4, np.float32)
        self._sampled_us = np.zeros(n, np.int64)
        self._sampled_j = np.zeros(n)
        self._deciding = self._started_us = np.zeros(0, np.int64)
        self.seen_us = np.zeros(n, np.int64)
        """(n,) capture times of the frames of the present decisions [µs]."""

    def begin(self, i: int, fleet: Fleet) -> None:
        """Start the record of slot i, with its vehicle at the start."""
        for tables in (self._samples, self._stamps, self._setpoints):
            tables.clear(i)
        self._take(fleet, np.array([i]))

    def next_us(self, fleet: Fleet) -> NDArray[np.int64]:
        """Return the times of the next samples (n,) [µs]."""
        return (fleet.time_us // SAMPLE_US + 1) * SAMPLE_US

    def sample(self, fleet: Fleet) -> None:
        """Sample the flights that are at a sampling time, or at their end."""
        # The final state is always recorded, as in `TrajectoryRecorder`.
        due = (fleet.time_us % SAMPLE_US == 0) | (fleet.verdict != FlightStatus.FLYING)
        self._take(fleet, np.flatnonzero(due & (fleet.time_us > self._sampled_us)))

    def _take(self, fleet: Fleet, who: NDArray[np.int64]) -> None:
        """Sample the vehicles of `who` (k,)."""
        now = fleet.time_us[who]
        first = now == 0
        # The first sample has no interval; 1 s avoids a division by zero.
        passed_s = np.where(first, 1.0, (now - self._sampled_us[who]) / constants.US_PER_S)
        mean_w = np.where(first, 0.0, (fleet.energy[who] - self._sampled_j[who]) / passed_s)
        state = [fleet.position[who], fleet.velocity[who], fleet.quaternion[who]]
        self._samples.append(who, np.column_stack([now, *state, mean_w]))
        self._sampled_us[who], self._sampled_j[who] = now, fleet.energy[who]

    def deciding(self, fleet: Fleet, seen_us: NDArray[np.int64]) -> None:
        """Start a decision of every active flight, on a frame captured at `seen_us` (n,)."""
        self._deciding = np.flatnonzero(fleet.verdict == FlightStatus.FLYING)
        self._started_us, self.seen_us = fleet.time_us.copy(), seen_us.copy()

    def decided(
        self,
        fleet: Fleet,
        setpoint: NDArray[np.float64],
        t2_us: NDArray[np.int64],
        transport_us: NDArray[np.int64],
        link_us: NDArray[np.int64],
    ) -> None:
        """Record the decision that `deciding` started, after its completion.

        Args:
            fleet: State at the start of the next decision.
            setpoint: (n, 4) result of the decision, as `Fleet.setpoint`.
            t2_us: (n,) inference as modelled, before rounding to ticks [µs].
            transport_us: (n,) capture to decoded frame [µs].
            link_us: (n,) setpoint sent to first motor command [µs].
        """
        who = self._deciding
        capture, start, end = self.seen_us[who], self._started_us[who], fleet.time_us[who]
        # The first frame of a flight is available at once.
        decoded = np.minimum(capture + transport_us[who], start)
        sent = start + t2_us[who]
        rows = np.column_stack([capture, decoded, start, sent, sent, sent + link_us[who], end])
        # Clear events after the end of the flight, and holds of unsent actions.
        rows[rows > end[:, None]] = NO_STAMP
        rows[sent > end, -1] = NO_STAMP
        self._stamps.append(who, rows)
        self._setpoints.append(who, setpoint[who])

    def trajectory(self, i: int) -> Trajectory:
        """Return the path of slot i: a row at the start, every 20 ms, and at the end.

        The first row has no preceding interval; its mean power is copied from the second row.
        """
        rows = self._samples.of(i)
        if len(rows) > 1:
            rows[0, 11] = rows[1, 11]
        return Trajectory(
            rows[:, 0].astype(np.int64), rows[:, 1:4], rows[:, 4:7], rows[:, 7:11], rows[:, 11]
        )

    def latency(self, i: int) -> dict[str, NDArray[Any]]:
        """Return the decisions of slot i by column: `STAMPS` (k,) [µs] and setpoints (k, 4)."""
        stamps = self._stamps.of(i)
        columns = {name: stamps[:, k].copy() for k, name in enumerate(STAMPS)}
        return {**columns, self._column: self._setpoints.of(i)}
