"""Level hil: the companion on this computer, against a simulator on another one.

TIMESYNC exchanges relate the two clocks. An answer is stamped between request and reception. An
exchange therefore gives the offset up to half its round trip, for any asymmetry (F. Cristian,
"Probabilistic clock synchronization", Distributed Computing 3, 1989). The exchange with the minimum
round trip is the best (the clock filter of NTP, RFC 5905, section 10). A line through the best
exchange before and the best one after gives the drift. The exchanges in between check it.
"""

from __future__ import annotations

import json
import signal
import threading
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from airl_mav.addons.profiling import measurement, policy_under_test
from airl_mav.core.child_process import signal_handlers
from airl_mav.core.clock import NS_PER_US, WallClock
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.progress import Bar
from airl_mav.latency.stamps import STAMPS
from airl_mav.policy.actions import AnyAction, Policy
from airl_mav.policy.observation import Observation
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.link_interface import LinkError
from companion.mavsdk_link import MavsdkLink
from companion.pilot import MissionResult, check_camera, fly_mission
from companion.program import mission_camera, prepare
from companion.systemd import every
from companion.watchdog import ThreadGuard

GOAL = 9_000.0, 0.0
"""North, east of the start [m]: out of reach."""

GROUND_EXCHANGES = 100
"""Number of TIMESYNC exchanges before the flight, and again after it."""

GROUND_INTERVAL_S = 0.005
"""Interval between them [s], out of step with the simulator's tick."""

FLIGHT_INTERVAL_S = 0.1
"""Interval between exchanges in flight [s]. Each takes 0.3 ms of processor time on a desktop core,
and one or two decisions of a hundred coincide with one."""


@dataclass(frozen=True)
class TimedMission:
    """Mission, and the exchanges with the simulator's clock."""

    result: MissionResult
    before: Exchanges
    during: Exchanges
    after: Exchanges


class DecisionLimit:
    """Policy that ends the flight after a number of decisions. Implements `actions.Policy`."""

    def __init__(self, policy: Policy, limit: int, stop: threading.Event, bar: Bar) -> None:
        self._policy, self._limit = policy, limit
        self._stop, self._bar = stop, bar
        self._count = 0

    def act(self, observation: Observation) -> AnyAction:
        """Return the policy's action."""
        # Stopped before the decision, because the pilot drops a decision interrupted by a stop.
        if self._count == self._limit:
            self._stop.set()
        else:
            self._count += 1
            self._bar.update(completed=self._count)
        return self._policy.act(observation)


def measure(
    request: measurement.ProfileRequest, policy: policy_under_test.PolicyUnderTest, bar: Bar
) -> measurement.Recording:
    """Fly until there are enough decisions; Ctrl-C lands. Arguments as `sitl.measure`."""
    load_us, first_us, _ = policy_under_test.cold_start(request, policy)
    interrupted, stop = threading.Event(), threading.Event()

    def interrupt(*_: object) -> None:
        interrupted.set()
        stop.set()

    with signal_handlers(interrupt, signal.SIGINT, signal.SIGTERM):
        try:
            mission = _fly(request, policy, bar, stop, interrupted)
        except LinkError as error:
            if interrupted.is_set():
                raise KeyboardInterrupt from None
            raise measurement.ProfilingError(str(error)) from error
    if interrupted.is_set():
        raise KeyboardInterrupt
    decisions = len(mission.result.log)
    if decisions < request.warm_up + request.decisions:
        raise measurement.ProfilingError(
            f"{mission.result.reason} after {decisions} decisions: too few"
        )
    stamps, exposure, remarks = relate_stamps(mission, request.warm_up)
    return measurement.Recording(
        flights=(stamps,),
        exposure=exposure,
        load_us=load_us,
        first_us=first_us,
        remarks=(
            f"in flight against a simulator elsewhere, hold {request.hold_s:g} s and at most "
            f"{measurement.FLOWN_SPEED_M_S:g} m/s: timing was measured, not the quality of flight",
            *remarks,
        ),
    )


def _fly(
    request: measurement.ProfileRequest,
    policy: policy_under_test.PolicyUnderTest,
    bar: Bar,
    stop: threading.Event,
    interrupted: threading.Event,
) -> TimedMission:
    """Fly until there are enough decisions, or until `stop`. Raises UsageError, LinkError."""
    asked = StandAloneCompanion(
        policy=policy.name,
        goal=GOAL,
        connect=request.connect,
        camera=request.camera,
        camera_key=request.camera_key,
        insecure=request.insecure,
        **request.flown_as,
    )
    mission = prepare(asked)
    decisions = request.warm_up + request.decisions
    limited = DecisionLimit(mission.policy, decisions, stop, bar)
    clock, abandon = WallClock(), threading.Event()
    with (
        closing(mission_camera(asked, mission, clock)) as frames,
        closing(TimesyncLink(asked.connect, clock, abandon)) as link,
    ):
        link.connect(asked.connect_timeout, stop)
        check_camera(mission.policy, frames, stop, mission.compensator)
        link.exchange(GROUND_EXCHANGES, GROUND_INTERVAL_S, stop)
        before = link.take_exchanges()
        with link.exchanging(FLIGHT_INTERVAL_S):
            flown = replace(mission, policy=limited, latency=None, start="arm")
            result = fly_mission(
                link, frames, flown, clock, stop, abandon, lambda _: None, ThreadGuard(clock)
            )
        during = link.take_exchanges()
        # `stop` is set by now: it ends the flight.
        link.exchange(GROUND_EXCHANGES, GROUND_INTERVAL_S, interrupted)
        return TimedMission(result, before, during, link.take_exchanges())


def relate_stamps(
    mission: TimedMission, warm_up: int
) -> tuple[measurement.Stamps, str, tuple[str, ...]]:
    """Convert the frames' exposure to this computer's clock, if the clocks can be related.

    Returns columns after the warm-up, with `exchange_*` columns of one row per exchange in flight;
    the stamp from which command age counts; remarks. `capture_us` is the exposure by this
    computer's clock, within `capture_uncertainty_us`, `capture_simulator_us` by the simulator's.
    """
    columns = mission.result.log.columns()
    stamps = {name: np.asarray(columns[name][warm_up:], np.int64) for name in STAMPS}
    exposed_us = stamps.pop("capture_us")
    during = mission.during
    flying = during.sent_us >= stamps["infer_start_us"][0]
    flying &= during.received_us <= stamps["held_until_us"][-1]
    exchanges = {
        "exchange_sent_us": during.sent_us[flying],
        "exchange_simulator_us": during.remote_us[flying],
        "exchange_received_us": during.received_us[flying],
    }
    try:
        relation = relate(mission.before, during, mission.after)
        captured_us = np.rint(relation.own_time(exposed_us)).astype(np.int64)
        # Plus one for rounding.
        within_us = np.ceil(relation.uncertainty_at(captured_us)).astype(np.int64) + 1
        if (early := int(np.count_nonzero(captured_us - within_us > stamps["decoded_us"]))) > 0:
            raise ClockError(
                f"{early} frames would have been decoded before they were exposed: they are "
                "stamped by another clock than the autopilot's, or it was set back"
            )
    except ClockError as error:
        remark = (
            "t1, link, control and end to end were not measured (-): nothing relates the "
            f"simulator's clock to this computer's: {error}"
        )
        return {**stamps, **exchanges}, "decoded_us", (remark,)
    related = {
        "capture_simulator_us": exposed_us,
        "capture_us": captured_us,
        "capture_uncertainty_us": within_us,
    }
    remarks = (
        _relation_remark(mission, relation, int(within_us.max())),
        "link, control and end to end were not measured (-): the autopilot reports only 10 times a "
        "second what it flies; a setpoint's way there is a part of the MAVLink round trip",
    )
    return {**related, **stamps, **exchanges}, "capture_us", remarks


def _relation_remark(mission: TimedMission, relation: ClockRelation, within_us: int) -> str:
    ground = " and ".join(
        f"{len(exchanges)} exchanges {when} the flight (least round trip "
        f"{exchanges.round_trip_us.min() / US_PER_MS:.3f} ms)"
        for exchanges, when in ((mission.before, "before"), (mission.after, "after"))
    )
    return (
        f"t1 is uncertain by ±{within_us / US_PER_MS:.3f} ms, all decisions alike: the simulator's "
        f"clock was related to this computer's by TIMESYNC, {ground}; it gained "
        f"{relation.drift * 1e6:+.1f} ppm (±{relation.drift_uncertainty * 1e6:.1f}), and "
        f"{relation.agreeing} of {relation.checked} exchanges in flight agree"
    )


MESSAGE = "TIMESYNC"

AUTOPILOT_COMPONENT = 1
"""MAV_COMP_ID_AUTOPILOT1: other components of the vehicle may answer too, by other clocks."""

LAST_ANSWER_S = 0.2
"""Wait time for the last answer of a series [s]."""


class TimesyncLink(MavsdkLink):
    """Link that also exchanges TIMESYNC with the flight controller."""

    _system_id: int
    _pending: set[int]
    """Send times of unanswered requests [µs]."""
    _answered: list[tuple[int, int, int]]

    def connect(self, timeout_s: float, stop: threading.Event | None = None) -> None:
        """Wait for a flight controller, as `MavsdkLink.connect`."""
        super().connect(timeout_s, stop)
        self._pending, self._answered = set(), []
        self._system_id = self._system.get_system_id()
        self._hear_messages(MESSAGE, self._hear)

    def exchange(self, count: int, interval_s: float, stop: threading.Event) -> None:
        """Send requests at an interval [s] after `connect`, and wait for the answers or `stop`."""
        asked_us = self._clock.time_us()
        for _ in range(count):
            if stop.is_set():
                return
            self._ask()
            asked_us += int(interval_s * US_PER_S)
            self._clock.sleep_until(asked_us, stop)
        self._clock.sleep_until(self._clock.time_us() + int(LAST_ANSWER_S * US_PER_S), stop)

    def exchanging(self, interval_s: float) -> AbstractContextManager[None]:
        """Return a context that sends requests at an interval [s] from a thread."""
        return every(int(interval_s * US_PER_S), self._ask, self._clock, "timesync")

    def take_exchanges(self) -> Exchanges:
        """Return the answered requests since the last call, in the order of the answers."""
        # Keeps answers that arrive during the copy.
        taken = self._answered[:]
        del self._answered[: len(taken)]
        columns = np.array(taken, np.int64).reshape(-1, 3)
        return Exchanges(columns[:, 0], columns[:, 1], columns[:, 2])

    def _ask(self) -> None:
        sent_us = self._clock.time_us()
        self._pending.add(sent_us)
        if not self.send_message(MESSAGE, {"tc1": 0, "ts1": sent_us * NS_PER_US}):
            # Treated as lost.
            self._pending.discard(sent_us)

    def _hear(self, message: Any, _: object) -> None:
        """Process an answer; called from a MAVSDK thread."""
        received_us = self._clock.time_us()
        sender = message.system_id, message.component_id
        if sender != (self._system_id, AUTOPILOT_COMPONENT):
            return
        fields = json.loads(message.fields_json)
        remote_ns, sent_us = fields["tc1"], fields["ts1"] // NS_PER_US
        # Requests of the flight controller have no tc1; ignore duplicate answers.
        if remote_ns == 0 or sent_us not in self._pending:
            return
        self._pending.discard(sent_us)
        self._answered.append((sent_us, remote_ns // NS_PER_US, received_us))


RESOLUTION_US = 1.0
"""Resolution of both clocks: whole microseconds, rounded down [µs]."""

GREATEST_DRIFT = 1e-3
"""Maximum relative rate of two real-time clocks, seconds per second: Linux corrects a clock by up
to 500 ppm (adjtimex), and both may be corrected."""

LEAST_EXCHANGES = 8
"""Minimum number of answers before, in between and after: the stages of NTP's clock filter."""

LEAST_AGREEING = 0.99
"""Minimum share of the exchanges in between that agree with the line. A single answer may contain a
stamp that was read just before its process was suspended."""


class ClockError(Exception):
    """The clocks cannot be related; the message is the reason."""


@dataclass(frozen=True)
class Exchanges:
    """Requests and answers; each (n,) int64 [µs]."""

    sent_us: NDArray[np.int64]
    """Request times, by the local clock."""
    remote_us: NDArray[np.int64]
    """Answer times, by the remote clock."""
    received_us: NDArray[np.int64]
    """Reception times, by the local clock."""

    def __len__(self) -> int:
        """Return the number of exchanges."""
        return len(self.sent_us)

    @property
    def round_trip_us(self) -> NDArray[np.int64]:
        """(n,) time from request to answer [µs]."""
        return self.received_us - self.sent_us

    @property
    def middle_us(self) -> NDArray[np.float64]:
        """(n,) midpoint between request and answer, by the local clock [µs]."""
        return self.sent_us + self.round_trip_us / 2.0

    @property
    def offset_us(self) -> NDArray[np.float64]:
        """(n,) lead of the remote clock for symmetric paths [µs]."""
        return self.remote_us - self.middle_us

    @property
    def uncertainty_us(self) -> NDArray[np.float64]:
        """(n,) maximum error of `offset_us` at `middle_us` [µs]."""
        return self.round_trip_us / 2.0 * (1.0 + GREATEST_DRIFT) + RESOLUTION_US


@dataclass(frozen=True)
class Reading:
    """Offset between two clocks at a time."""

    at_us: float
    """Time by the local clock [µs]."""
    offset_us: float
    """Remote clock minus local clock [µs]."""
    uncertainty_us: float
    """Maximum error of the offset [µs]."""


def best_reading(exchanges: Exchanges) -> Reading:
    """Return the reading of the minimum round trip; ClockError unless a majority agrees."""
    n = len(exchanges)
    if n < LEAST_EXCHANGES:
        raise ClockError(f"{n} answers in a row, {LEAST_EXCHANGES} are needed")
    at, offset, within = exchanges.middle_us, exchanges.offset_us, exchanges.uncertainty_us
    for i in np.argsort(exchanges.round_trip_us, kind="stable"):
        apart = np.abs(offset - offset[i])
        agree = apart <= within + within[i] + GREATEST_DRIFT * np.abs(at - at[i])
        if 2 * np.count_nonzero(agree) > n:
            return Reading(float(at[i]), float(offset[i]), float(within[i]))
    raise ClockError("the answers contradict each other, as if a clock did not keep real time")


@dataclass(frozen=True)
class ClockRelation:
    """Offset of the remote clock as a line over the local clock."""

    before: Reading
    after: Reading
    checked: int
    """Number of exchanges in between."""
    agreeing: int
    """Number of them that agree with the line."""

    @property
    def drift(self) -> float:
        """Gain of the remote clock, seconds per local second."""
        span_us = self.after.at_us - self.before.at_us
        return (self.after.offset_us - self.before.offset_us) / span_us

    @property
    def drift_uncertainty(self) -> float:
        """Maximum error of the drift."""
        span_us = self.after.at_us - self.before.at_us
        return (self.after.uncertainty_us + self.before.uncertainty_us) / span_us

    def offset_at(self, own_us: ArrayLike) -> NDArray[np.float64]:
        """Return the lead of the remote clock [µs] at local times [µs]."""
        after_before = np.asarray(own_us, np.float64) - self.before.at_us
        return np.asarray(self.before.offset_us + self.drift * after_before)

    def uncertainty_at(self, own_us: ArrayLike) -> NDArray[np.float64]:
        """Return the maximum error of `offset_at` [µs], if both clocks run evenly."""
        span_us = self.after.at_us - self.before.at_us
        share = (np.asarray(own_us, np.float64) - self.before.at_us) / span_us
        a, b = self.before.uncertainty_us, self.after.uncertainty_us
        return np.asarray(np.abs(1.0 - share) * a + np.abs(share) * b)

    def own_time(self, remote_us: ArrayLike) -> NDArray[np.float64]:
        """Convert times of the remote clock [µs] to the local clock [µs]."""
        # remote = own + before.offset + drift (own - before.at), solved for own.
        remote_before = self.before.at_us + self.before.offset_us
        told = np.asarray(remote_us, np.float64) - remote_before
        return np.asarray(self.before.at_us + told / (1.0 + self.drift))


def relate(before: Exchanges, between: Exchanges, after: Exchanges) -> ClockRelation:
    """Return the line through the best exchange before and after, checked with the rest."""
    first, last = best_reading(before), best_reading(after)
    if len(between) < LEAST_EXCHANGES:
        raise ClockError(f"{len(between)} answers in between, {LEAST_EXCHANGES} are needed")
    if last.at_us <= first.at_us:
        raise ClockError("no time between the exchanges before and after")
    relation = ClockRelation(first, last, 0, 0)
    if abs(relation.drift) > GREATEST_DRIFT + relation.drift_uncertainty:
        raise ClockError(
            f"the other clock gained {relation.drift * 1e6:+,.0f} ppm, more than any clock of real "
            f"time ({GREATEST_DRIFT * 1e6:,.0f} ppm)"
        )
    at = between.middle_us
    off = np.abs(between.offset_us - relation.offset_at(at))
    agree = off <= between.uncertainty_us + relation.uncertainty_at(at)
    agreeing = int(np.count_nonzero(agree))
    if agreeing < LEAST_AGREEING * len(between):
        worst_ms = float(off.max()) / US_PER_MS
        raise ClockError(
            f"the clocks did not run evenly: {len(between) - agreeing} of {len(between)} exchanges "
            f"contradict the line by up to {worst_ms:.3f} ms"
        )
    return ClockRelation(first, last, len(between), agreeing)
