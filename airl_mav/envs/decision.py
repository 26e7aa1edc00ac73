"""Timing of one decision of n vehicles: the events between two observations.

Sequential, as in the paper: observe, infer, act, hold, and observe again. Pipelined: the next
decision starts with the newest frame as soon as the last one is ready; no action is held.

A decision is a list of events, each at a tick relative to the observation. `fleet_step.advance`
simulates from event to event without Python. With body rate commands, the flight controller only
changes the setpoint type when it publishes its control mode, twice a second
(`control.demand.KIND_US`). If a decision is overdue, the companion's watchdog stops the vehicle
(`companion.watchdog`): first with zero rates, after the next publication with zero velocity.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.control.demand import KIND_US
from airl_mav.core.constants import TICK_US
from airl_mav.core.kernels import borrowing_kernel, kernel, large_borrowing_kernel
from airl_mav.envs.faults import BEFORE_US, later_in
from airl_mav.envs.fleet import (
    ATTITUDE,
    BY_RATES,
    POSITION,
    RATES,
    VELOCITY,
    YAW_RATE,
    Fleet,
    FlightStatus,
    FramePoses,
    State,
)
from airl_mav.policy.actions import ALTITUDE_P, MAX_VERTICAL_M_S

RATES_FOLLOWED_US = KIND_US - 100_000
"""Earliest time in a flight at which body rates take effect [µs]. Before, the flight controller
follows the velocity setpoint that the companion sent a tenth of a second before the flight, when it
switched to offboard (`companion.mavsdk_link.OFFBOARD_SETTLE_S`)."""

NEVER_US: Final = 10**12
"""Time beyond the end of any flight [µs]."""

_SEND: Final = 0  # the setpoint leaves the companion
_STOP: Final = 1  # a stop arrives because the last setpoint expired
_ACCEPT: Final = 2  # the setpoint arrives
_CAPTURE: Final = 3  # the next observation's frame is captured
_END: Final = 4  # the next decision begins
_ARRIVE: Final = 5  # a setpoint of an earlier decision arrives; higher numbers are older ones
_MOST: Final = 6  # maximum events of a decision, without earlier setpoints

_FLYING: Final = int(FlightStatus.FLYING)


class FrameTimes(NamedTuple):
    """Frame timing at a camera's rate; the phase to the decisions differs between episodes."""

    first_us: NDArray[np.int64]
    """(n,) capture time of each episode's first frame [µs]."""
    period_us: int
    transport_us: int
    """Time from capture to decoded frame [µs]."""
    late: NDArray[np.int64]
    """(k, 3) `faults.delays_of` the camera."""


class Timing(NamedTuple):
    """Times of every decision of an environment."""

    pipelined: bool
    link_us: int
    """Time from sending a setpoint to its acceptance [µs]."""
    hold_us: int
    """Sequential: time from sending an action to the next observation [µs]."""
    hover_us: int
    """Sequential: time after the observation at which velocity is zeroed [µs]; negative = never."""
    timeout: int
    """Body rates: ticks after which a stop replaces a setpoint; negative = velocity commands."""
    altitude_m: float
    """Altitude hold height for actions without a vertical speed [m]."""
    uplink: NDArray[np.int64]
    """(k, 3) `faults.delays_of` the uplink."""
    frames: FrameTimes


class DecisionBatch(NamedTuple):
    """Present decision of n vehicles; rows are updated in place."""

    timing: Timing
    errors: NDArray[np.float64]  # (n, 9) errors of telemetry
    began_us: NDArray[np.int64]  # (n,) time of the observation
    t2_us: NDArray[np.int64]  # (n,) inference
    before_m: NDArray[np.float64]  # (n,) distance to the goal at the observation
    flying: NDArray[np.bool_]  # (n,) True if the flight had not ended at the observation
    setpoint: NDArray[np.float64]  # (n, 4) as `Fleet.setpoint`
    tick: NDArray[np.int64]  # (n, k) ticks of events relative to `began_us`
    kind: NDArray[np.int64]  # (n, k)
    events: NDArray[np.int64]  # (n,) number of events
    next: NDArray[np.int64]  # (n,) index of the next event
    age: NDArray[np.int64]  # (n,) age of the next observation's frame in ticks
    pause_us: NDArray[np.int64]  # (n,) time of the next call into Python
    seen: FramePoses
    accepted: NDArray[np.int64]  # (n,) tick
    left: NDArray[np.int64]  # (n, k) ticks until earlier setpoints arrive, newest first; 0 = none
    in_flight: NDArray[np.float64]  # (n, k, 4) the corresponding setpoints
    newest: NDArray[np.float64]  # (n, 4) the newest body rates and thrust
    wanted: NDArray[np.bool_]  # (n,) True if `newest` is newer than a stop
    sent_us: NDArray[np.int64]  # (n,) sending time of the last setpoint; 0 = none


def new_decision(timing: Timing, errors: NDArray[np.float64]) -> DecisionBatch:
    """Return empty decisions of n vehicles with telemetry errors (n, 9)."""
    # A pipelined decision takes at least one tick.
    n, room = len(errors), max(-(-timing.link_us // TICK_US), 1)

    def whole(*shape: int) -> NDArray[np.int64]:
        return np.zeros((n, *shape), np.int64)

    seen = FramePoses(whole(), *(np.zeros((n, size)) for size in (3, 4, 3, 3)))
    return DecisionBatch(
        timing=timing,
        errors=errors,
        began_us=whole(),
        t2_us=whole(),
        before_m=np.zeros(n),
        flying=np.zeros(n, np.bool_),
        setpoint=np.zeros((n, 4)),
        tick=whole(room + _MOST),
        kind=whole(room + _MOST),
        events=whole(),
        next=whole(),
        age=whole(),
        pause_us=np.full(n, NEVER_US),
        seen=seen,
        accepted=whole(),
        left=whole(room),
        in_flight=np.zeros((n, room, 4)),
        newest=np.zeros((n, 4)),
        wanted=np.zeros(n, np.bool_),
        sent_us=whole(),
    )


def begin_decision(decision: DecisionBatch, i: int) -> None:
    """Start the flight of vehicle i with no setpoints in flight."""
    decision.left[i] = 0
    decision.newest[i], decision.wanted[i], decision.sent_us[i] = 0.0, False, 0


@large_borrowing_kernel
def plan(decision: DecisionBatch, fleet: Fleet) -> None:
    """Schedule the events of all decisions from their setpoints and inference times."""
    for i in range(len(decision.t2_us)):
        decision.began_us[i] = fleet.time_us[i]
        decision.flying[i] = fleet.verdict[i] == _FLYING
        decision.events[i] = decision.next[i] = 0
        if decision.timing.pipelined:
            _plan_pipelined(decision, fleet.time_us[i], i, decision.t2_us[i])
        else:
            _plan_sequential(decision, fleet.time_us[i], i, decision.t2_us[i])


@borrowing_kernel
def _add(decision: DecisionBatch, i: int, tick: int, kind: int) -> None:
    """Insert an event of vehicle i after all events at the same tick or earlier."""
    # Insertion sort: a decision has few events.
    at = decision.events[i]
    ticks, kinds = decision.tick[i], decision.kind[i]
    while at > 0 and ticks[at - 1] > tick:
        ticks[at], kinds[at] = ticks[at - 1], kinds[at - 1]
        at -= 1
    ticks[at], kinds[at] = tick, kind
    decision.events[i] += 1


@borrowing_kernel
def _plan_sequential(decision: DecisionBatch, now_us: int, i: int, t2_us: int) -> None:
    timing = decision.timing
    arrives_us = t2_us + timing.link_us + later_in(timing.uplink, now_us + t2_us)
    sent, accepted = ticks_of(t2_us), ticks_of(arrives_us)
    stop_us = NEVER_US if timing.hover_us < 0 else timing.hover_us
    if timing.timeout >= 0:
        overdue = _overdue(decision, i, now_us)
        # A setpoint replaced in time never expires, even while the next one is in flight.
        if overdue < sent:
            # The earlier of the two stops counts.
            stop_us = min(stop_us, overdue * TICK_US)
        decision.sent_us[i] = now_us + TICK_US * sent
    # A stop has the same link delay as a setpoint.
    stop = ticks_of(stop_us + timing.link_us + later_in(timing.uplink, now_us + stop_us))
    _add(decision, i, sent, _SEND)
    if 0 <= stop < accepted:
        # The stop arrives before the setpoint is sent, or shortly after.
        _add(decision, i, stop, _STOP)
    ended = sent + timing.hold_us // TICK_US
    _add(decision, i, accepted, _ACCEPT)
    # Its tick depends on the frame's age, known at acceptance.
    _add(decision, i, ended, _CAPTURE)
    _add(decision, i, ended, _END)
    decision.accepted[i] = accepted


@borrowing_kernel
def _plan_pipelined(decision: DecisionBatch, now_us: int, i: int, t2_us: int) -> None:
    timing = decision.timing
    sent, accepted = ticks_of(t2_us), ticks_of(t2_us + timing.link_us)
    # Rounded up, so that the frame is decoded by then.
    frame = -((now_us - decoded_after_us(timing.frames, i, now_us)) // TICK_US)
    ended = max(sent, frame)
    age = min(ticks_of(frame_age_us(timing.frames, i, now_us + ended * TICK_US)), ended)
    decision.age[i], decision.accepted[i] = age, accepted
    # The oldest setpoint in flight arrives first.
    for k in range(decision.left.shape[1] - 1, -1, -1):
        if 0 < decision.left[i, k] <= ended:
            _add(decision, i, decision.left[i, k], _ARRIVE + k)
    # The frame was captured `age` ticks before the next decision starts.
    _add(decision, i, ended - age, _CAPTURE)
    _add(decision, i, sent, _SEND)
    # A later arrival is kept by `_keep_in_flight`.
    if accepted <= ended:
        _add(decision, i, accepted, _ACCEPT)
    if timing.timeout >= 0:
        # A stop has the link delay of a setpoint, but arrives before the next one, and within the
        # decision.
        overdue, link = _overdue(decision, i, now_us), timing.link_us // TICK_US
        again = sent + timing.timeout
        if 0 <= overdue < sent:
            _add(decision, i, min(overdue + link, ended), _STOP)
        if again < ended:
            _add(decision, i, min(again + link, ended), _STOP)
        decision.sent_us[i] = now_us + TICK_US * sent
    _add(decision, i, ended, _END)


@borrowing_kernel
def _overdue(decision: DecisionBatch, i: int, now_us: int) -> int:
    """Return the ticks until the companion's timeout triggers a stop; negative = in the past."""
    overdue: int = (decision.sent_us[i] - now_us) // TICK_US + decision.timing.timeout
    return overdue


@borrowing_kernel
def next_stretch(decision: DecisionBatch, fleet: Fleet, i: int, state: State, j: int) -> int:
    """Execute the due events of vehicle i's decision; the vehicle is in SIMD lane j.

    After the end of a flight all events are due. Time and verdict of `fleet` must be up to date.

    Returns:
        Ticks until the next event; 0 if the decision is complete, or Python is needed.
    """
    over = fleet.verdict[i] != _FLYING
    now = (fleet.time_us[i] - decision.began_us[i]) // TICK_US
    while decision.next[i] < decision.events[i] and (
        over or decision.tick[i, decision.next[i]] <= now
    ):
        event = decision.next[i]
        decision.next[i] += 1
        _carry_out(decision, fleet, i, state, j, event)
    # At the end of a flight the remaining events have been executed above.
    if over or decision.next[i] == decision.events[i]:
        return 0
    until: int = min(
        decision.tick[i, decision.next[i]] - now,
        (decision.pause_us[i] - fleet.time_us[i]) // TICK_US,
    )
    # The requested setpoint type differs from the followed one: wait for the next publication.
    if decision.timing.timeout >= 0 and decision.wanted[i] != fleet.by_rates[i] and until > 0:
        published = _until_published(fleet.time_us[i])
        if published == 0:
            fleet.by_rates[i] = decision.wanted[i]
            state[BY_RATES, j] = fleet.by_rates[i]
            _follow(decision, fleet, i, state, j)
        else:
            until = min(until, published)
    return max(until, 0)


@kernel
# Publications start at RATES_FOLLOWED_US and repeat every KIND_US.
def _until_published(time_us: int) -> int:
    """Return the ticks until the flight controller next publishes its control mode."""
    first, period = (RATES_FOLLOWED_US - time_us) // TICK_US, KIND_US // TICK_US
    return first if first >= 0 else first % period


@borrowing_kernel
def _carry_out(
    decision: DecisionBatch, fleet: Fleet, i: int, state: State, j: int, event: int
) -> None:
    """Execute an event of vehicle i; arguments as in `next_stretch`."""
    timing = decision.timing
    kind = decision.kind[i, event]
    if kind == _SEND:
        # NaN is altitude hold: a proportional vertical speed with a limit.
        if math.isnan(decision.setpoint[i, 2]):
            error_m = -timing.altitude_m - (state[POSITION + 2, j] + decision.errors[i, 2])
            down = min(max(ALTITUDE_P * error_m, -MAX_VERTICAL_M_S), MAX_VERTICAL_M_S)
            decision.setpoint[i, 2] = down
    elif kind == _STOP:
        expire(decision, fleet, i, state, j)
    elif kind == _CAPTURE:
        _look(decision.seen, fleet.time_us[i], i, state, j)
    elif kind == _END:
        _keep_in_flight(decision, i, decision.tick[i, event])
    elif kind == _ACCEPT:
        take(decision, fleet, decision.setpoint[i], i, state, j)
        if not timing.pipelined:
            # The capture and end events come next.
            left = decision.tick[i, event + 2] - decision.tick[i, event]
            then_us = fleet.time_us[i] + left * TICK_US
            decision.age[i] = min(ticks_of(frame_age_us(timing.frames, i, then_us)), left)
            decision.tick[i, event + 1] = decision.tick[i, event + 2] - decision.age[i]
    else:
        take(decision, fleet, decision.in_flight[i, kind - _ARRIVE], i, state, j)


@borrowing_kernel
def take(
    decision: DecisionBatch,
    fleet: Fleet,
    setpoint: NDArray[np.float64],
    i: int,
    state: State,
    j: int,
) -> None:
    """Set the setpoint (4,) of vehicle i; arguments as in `next_stretch`."""
    # With body rates the setpoint waits until the flight controller follows them.
    if decision.timing.timeout >= 0:
        for axis in range(4):
            decision.newest[i, axis] = setpoint[axis]
        decision.wanted[i] = True
        if fleet.by_rates[i]:
            _follow(decision, fleet, i, state, j)
        return
    for axis in range(4):
        fleet.setpoint[i, axis] = setpoint[axis]
    # The next tick converts it to NED.
    state[YAW_RATE, j], fleet.repeat_us[i] = setpoint[3], fleet.time_us[i]


@borrowing_kernel
def expire(decision: DecisionBatch, fleet: Fleet, i: int, state: State, j: int) -> None:
    """Stop vehicle i; with body rates, zero the rates first. Arguments as in `next_stretch`."""
    if decision.timing.timeout >= 0:
        # The thrust remains; only the three rates become 0.
        for axis in range(3):
            decision.newest[i, axis] = 0.0
        decision.wanted[i] = False
        if fleet.by_rates[i]:
            _follow(decision, fleet, i, state, j)
        return
    for axis in range(4):
        fleet.setpoint[i, axis] = 0.0
    state[YAW_RATE, j], fleet.repeat_us[i] = 0.0, fleet.time_us[i]


@borrowing_kernel
def _follow(decision: DecisionBatch, fleet: Fleet, i: int, state: State, j: int) -> None:
    """Apply the newest setpoint of the control mode that vehicle i follows."""
    for axis in range(4):
        fleet.setpoint[i, axis] = decision.newest[i, axis] if fleet.by_rates[i] else 0.0
    state[YAW_RATE, j], fleet.repeat_us[i] = fleet.setpoint[i, 3], fleet.time_us[i]


@borrowing_kernel
def _look(seen: FramePoses, now_us: int, i: int, state: State, j: int) -> None:
    """Record the capture pose of vehicle i, in SIMD lane j."""
    seen.time_us[i] = now_us
    for axis in range(3):
        seen.position[i, axis] = state[POSITION + axis, j]
        seen.velocity[i, axis] = state[VELOCITY + axis, j]
        seen.omega[i, axis] = state[RATES + axis, j]
    for axis in range(4):
        seen.quaternion[i, axis] = state[ATTITUDE + axis, j]


@borrowing_kernel
def _keep_in_flight(decision: DecisionBatch, i: int, ended: int) -> None:
    """Keep the setpoints of vehicle i still in flight when its decision ends at a tick."""
    # From the oldest on, so that no entry is overwritten before it is copied.
    left, in_flight = decision.left[i], decision.in_flight[i]
    for k in range(len(left) - 1, -1, -1):
        left[k] = max((left[k - 1] if k > 0 else decision.accepted[i]) - ended, 0)
        for axis in range(4):
            in_flight[k, axis] = in_flight[k - 1, axis] if k > 0 else decision.setpoint[i, axis]


@kernel
def ticks_of(time_us: int) -> int:
    """Round a time [µs] to whole ticks."""
    return (time_us + TICK_US // 2) // TICK_US


@kernel
def frame_age_us(times: FrameTimes, i: int, time_us: int) -> int:
    """Return the age of vehicle i's newest decoded frame at a time [µs] of its episode."""
    # Frames are decoded a transport time after their capture, one per period.
    since_us = time_us - times.transport_us - times.first_us[i]
    age: int = times.transport_us + since_us % times.period_us
    for k in range(len(times.late)):
        age = _delayed(times, i, time_us, age, k)
    return age


@kernel
def _delayed(times: FrameTimes, i: int, time_us: int, age_us: int, k: int) -> int:
    """Return the age of the newest frame with the delay of fault k; frames arrive in order."""
    from_us, to_us, delay_us = times.late[k, 0], times.late[k, 1], times.late[k, 2]
    healthy = time_us - age_us
    # Frames after the fault wait for the last delayed frame.
    last = _newest(times, i, to_us - 1)
    if healthy < from_us or time_us - times.transport_us >= last + delay_us:
        return age_us
    # With a delay, the newest decoded frame is older by the delay.
    arrived = _newest(times, i, time_us - times.transport_us - delay_us)
    # Frames from before the fault were not delayed and may be newer.
    if from_us != BEFORE_US:
        arrived = max(arrived, _newest(times, i, from_us - 1))
    return time_us - arrived


@kernel
def _newest(times: FrameTimes, i: int, time_us: int) -> int:
    """Return the capture time of the newest frame at a time [µs]."""
    newest: int = time_us - (time_us - times.first_us[i]) % times.period_us
    return newest


@kernel
def decoded_after_us(times: FrameTimes, i: int, time_us: int) -> int:
    """Return the decoding time of vehicle i's next frame after a time [µs] of its episode."""
    since_us = (time_us - times.transport_us - times.first_us[i]) % times.period_us
    decoded: int = time_us - since_us + times.period_us
    return decoded
