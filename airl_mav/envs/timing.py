"""When decisions begin, act and end, of n vehicles at a time.

Sequential, as in the paper: observe, infer, act, hold, and observe again. Pipelined: the next
decision begins with the newest frame as soon as the last one is ready; nothing is held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.envs.cameras import Cameras
from airl_mav.envs.faults import TwinFault, later_us
from airl_mav.envs.fleet import Fleet
from airl_mav.envs.rate_setpoints import RateSetpoints
from airl_mav.envs.saved_state import Stateful

Times = NDArray[np.int64]
"""(n,) [µs], or in ticks."""

_NEVER_US = 10**12
"""Later than any flight ends [µs]."""


class Vehicles(Protocol):
    """What a decision is flown with: n vehicles and their cameras."""

    @property
    def fleet(self) -> Fleet:
        """Their state."""
        ...

    @property
    def cameras(self) -> Cameras:
        """Their cameras."""
        ...

    def advance(self, ticks: Times) -> None:
        """Fly each one for so many ticks (n,)."""
        ...

    def capture(self, who: NDArray[np.bool_]) -> None:
        """Take the frames of those in `who` (n,)."""
        ...

    def advance_in_legs(self, ticks: Times, setpoints: NDArray[np.float64]) -> bool:
        """Fly three legs of so many ticks (n, 3), where nothing else happens on the way.

        All take the setpoints (n, 4) after the first leg, and their frames after the second. As
        `advance`, `give` and `capture` in turn, in less time.

        Returns:
            Whether they have flown; False: something may happen on the way.
        """
        ...

    def holding_altitude(self) -> NDArray[np.float64]:
        """Return the downward speeds (n,) [m/s] that hold the altitude, as telemetry has it."""
        ...


class Timing(Protocol):
    """How a decision is flown."""

    def begin(self, i: int) -> None:
        """Begin the flight of vehicle i."""
        ...

    def fly(self, vehicles: Vehicles, setpoints: NDArray[np.float64], t2_us: Times) -> Times:
        """Fly one decision of every vehicle, from its observation to the next one.

        Args:
            vehicles: What flies.
            setpoints: (n, 4) forward, right, down [m/s], yaw rate [rad/s]; the third, where it is
                NaN, is written when it is sent: it then holds the altitude. Or body rates and
                thrusts (`RateSetpoints`).
            t2_us: (n,) time of the inference.

        Returns:
            (n,) age of the frames of the next observation [µs].
        """
        ...


class SequentialTiming(Stateful):
    """After its hold, a decision is followed by the next."""

    def __init__(
        self,
        cameras: Cameras,
        link_us: int,
        hold_us: int,
        hover_us: int | None,
        uplink: Sequence[TwinFault] = (),
        rates: RateSetpoints | None = None,
    ) -> None:
        """Take the times.

        Args:
            cameras: Of the vehicles.
            link_us: Setpoint sent to accepted [µs].
            hold_us: How long an action is held before the next observation [µs].
            hover_us: The velocity is zeroed so long after the hold when no new action has come;
                None: the last one persists [µs].
            uplink: Faults by which setpoints arrive later.
            rates: Where body rates are commanded; None: velocities are.

        Raises:
            UsageError: The hold is so short that a decision would have to wait for its frame.
        """
        self._link_us, self._hold_us, self._hover_us = link_us, hold_us, hover_us
        self._uplink, self._rates = uplink, rates
        late_us = round(sum(each.fault.amount for each in uplink) * US_PER_S)
        least_us = link_us + late_us + cameras.latest_us + cameras.period_us
        if hold_us < least_us:
            raise UsageError(
                f"episode.hold_s = {hold_us / 1e6:g}: accepted: value >= {least_us / 1e6:g} s "
                f"(delay.link_ms, delay.transport_ms and {cameras.period_us / 1e3:g} ms between two"
                " frames, and what faults delay)"
            )

    def begin(self, i: int) -> None:
        """Begin the flight of vehicle i: nothing is in flight when a decision begins."""
        if self._rates is not None:
            self._rates.begin(i)

    def fly(self, vehicles: Vehicles, setpoints: NDArray[np.float64], t2_us: Times) -> Times:
        """Fly one decision of every vehicle; see `Timing`."""
        fleet = vehicles.fleet
        # Ticks are counted from the observation that is being decided on.
        arrives_us = t2_us + self._link_us
        if self._uplink:
            arrives_us += later_us(self._uplink, fleet.time_us + t2_us)
        sent, accepted = ticks_of(t2_us), ticks_of(arrives_us)
        stop = self._stop(fleet.time_us, sent)
        if self._rates is not None:
            self._rates.sent(fleet.time_us + TICK_US * sent)
        self._wait(vehicles, np.zeros_like(sent), sent, stop)
        _hold_altitude(vehicles, setpoints, np.ones(len(sent), np.bool_))
        left, link = sent + self._hold_us // TICK_US - accepted, accepted - sent
        arrives_us = fleet.time_us + link * TICK_US
        age = self._age(vehicles, arrives_us, left)
        if stop is None and vehicles.advance_in_legs(
            np.stack([link, left - age, age], axis=1), setpoints
        ):
            early = fleet.time_us < arrives_us
            if early.any():
                age[early] = self._age(vehicles, fleet.time_us, left)[early]
        else:
            self._wait(vehicles, sent, accepted, stop)
            everyone = np.ones(len(sent), np.bool_)
            give(fleet, setpoints, everyone, self._rates)
            age = self._age(vehicles, fleet.time_us, left)
            advance(vehicles, left - age, self._rates)
            vehicles.capture(fleet.verdict >= 0)
            advance(vehicles, age, self._rates)
        aged: Times = TICK_US * age
        return aged

    def _age(self, vehicles: Vehicles, now_us: Times, left: Times) -> Times:
        """Return the age (n,) of the newest frames `left` ticks after a time, `left` at most."""
        return np.minimum(ticks_of(vehicles.cameras.age_us(now_us + left * TICK_US)), left)

    def _stop(self, began_us: Times, sent: Times) -> Times | None:
        """Return the ticks (n,) after which the last setpoint expires; None: it never does.

        That is a while after its hold, or, of body rates, when the next decision is overdue, which
        is sent so many ticks (n,) from now.
        """
        stop_us: Times | None = None
        if self._hover_us is not None:
            stop_us = np.full(len(began_us), self._hover_us, np.int64)
        if self._rates is not None:
            overdue = self._rates.overdue(began_us)
            # What is replaced in time never expires, though the next is on its way.
            overdue_us = np.where(overdue < sent, overdue * TICK_US, _NEVER_US)
            stop_us = overdue_us if stop_us is None else np.minimum(stop_us, overdue_us)
        if stop_us is None:
            return None
        # The stop takes as long to arrive as any setpoint.
        late_us = later_us(self._uplink, began_us + stop_us) if self._uplink else 0
        return ticks_of(stop_us + self._link_us + late_us)

    def _wait(self, vehicles: Vehicles, start: Times, end: Times, stop: Times | None) -> None:
        """Fly on the last setpoint from one tick to another; it may expire in between."""
        if stop is None:
            advance(vehicles, end - start, self._rates)
            return
        fleet = vehicles.fleet
        reached = np.clip(stop, start, end)
        advance(vehicles, reached - start, self._rates)
        over = (stop >= start) & (stop < end)
        if self._rates is not None:
            self._rates.stop(fleet, over)
        else:
            fleet.setpoint[over] = 0.0
            fleet.repeat_us[over] = fleet.time_us[over]
        advance(vehicles, end - reached, self._rates)

    def _held(self) -> Mapping[str, Any]:
        return {} if self._rates is None else {"rates": self._rates}


class PipelinedTiming(Stateful):
    """A decision is followed by the next as soon as it is ready and there is a newer frame.

    The vehicle may not have taken the new setpoint yet when the next decision begins, nor those
    before it: they are in flight. A frame that was on its way when a decision began is taken as it
    begins: it is too new by the time of its transport at most.
    """

    def __init__(self, n: int, link_us: int, rates: RateSetpoints | None = None) -> None:
        """Prepare n vehicles.

        Args:
            n: How many.
            link_us: Time from a setpoint sent to accepted [µs].
            rates: Where body rates are commanded; None: velocities are.
        """
        self._link_us, self._rates = link_us, rates
        # A decision lasts a tick at least.
        room = max(-(-link_us // TICK_US), 1)
        self._left = np.zeros((n, room), np.int64)
        """Ticks until the setpoints in flight are accepted, the newest first; 0: none is."""
        self._in_flight = np.zeros((n, room, 4))

    def begin(self, i: int) -> None:
        """Begin the flight of vehicle i: nothing is in flight."""
        self._left[i] = 0
        if self._rates is not None:
            self._rates.begin(i)

    def fly(self, vehicles: Vehicles, setpoints: NDArray[np.float64], t2_us: Times) -> Times:
        """Fly one decision of every vehicle; see `Timing`."""
        fleet, cameras = vehicles.fleet, vehicles.cameras
        began_us, now = fleet.time_us.copy(), np.zeros(len(t2_us), np.int64)
        # Ticks from the observation that is being decided on.
        sent, accepted = ticks_of(t2_us), ticks_of(t2_us + self._link_us)
        # Up, or the frame would not be there yet.
        frame = -((began_us - cameras.next_decoded_us(began_us)) // TICK_US)
        ended = np.maximum(sent, frame)
        age = np.minimum(ticks_of(cameras.age_us(began_us + ended * TICK_US)), ended)
        room = self._left.shape[1]
        # The oldest in flight is the first to arrive.
        due = np.column_stack([self._left[:, ::-1], ended - age, sent, accepted])
        if self._rates is not None:
            due = np.column_stack([due, *self._stops(self._rates.overdue(began_us), sent, ended)])
            self._rates.sent(began_us + TICK_US * sent)
        happens = due <= ended[:, None]
        happens[:, :room] &= due[:, :room] > 0
        due = np.minimum(due, ended[:, None])
        each = np.arange(len(due))
        for event in np.argsort(due, axis=1, kind="stable").T:
            advance(vehicles, due[each, event] - now, self._rates)
            now, real = due[each, event], happens[each, event]
            for k in range(room):
                in_flight, arrived = self._in_flight[:, room - 1 - k], (event == k) & real
                give(fleet, in_flight, arrived, self._rates)
            captured, decided = event == room, event == room + 1
            if captured.any():
                vehicles.capture(captured)
            if decided.any():
                _hold_altitude(vehicles, setpoints, decided)
            give(fleet, setpoints, (event == room + 2) & real, self._rates)
            if self._rates is not None:
                self._rates.stop(fleet, (event > room + 2) & real)
        advance(vehicles, ended - now, self._rates)
        self._left[:, 1:] = np.maximum(self._left[:, :-1] - ended[:, None], 0)
        self._in_flight[:, 1:] = self._in_flight[:, :-1]
        self._left[:, 0] = np.maximum(accepted - ended, 0)
        self._in_flight[:, 0] = setpoints
        aged: Times = TICK_US * age
        return aged

    def _stops(self, overdue: Times, sent: Times, ended: Times) -> tuple[Times, Times]:
        """Return the ticks (n,) at which stops arrive, before the setpoint and behind it.

        What does not happen in this decision comes after its end. A stop takes as long as any
        setpoint, but is there before the next, and by the end of the decision.
        """
        if self._rates is None:
            raise ValueError("velocities are not replaced by a stop")
        link, never = self._link_us // TICK_US, ended + 1
        again = sent + self._rates.timeout
        before, behind = (np.minimum(at + link, ended) for at in (overdue, again))
        return (
            np.where((overdue >= 0) & (overdue < sent), before, never),
            np.where(again < ended, behind, never),
        )

    def _held(self) -> Mapping[str, Any]:
        held: dict[str, Any] = {"left": self._left, "in_flight": self._in_flight}
        return held if self._rates is None else {**held, "rates": self._rates}


def _hold_altitude(
    vehicles: Vehicles, setpoints: NDArray[np.float64], who: NDArray[np.bool_]
) -> None:
    """Write the downward speeds of those in `who` (n,) whose actions say nothing of them."""
    silent = who & np.isnan(setpoints[:, 2])
    if silent.any():
        setpoints[silent, 2] = vehicles.holding_altitude()[silent]


def give(
    fleet: Fleet,
    setpoints: NDArray[np.float64],
    who: NDArray[np.bool_],
    rates: RateSetpoints | None = None,
) -> None:
    """Give the vehicles in `who` (n,) their setpoints (n, 4), velocities or `rates`.

    Velocities are flown at once.
    """
    if rates is not None:
        rates.take(fleet, setpoints, who)
        return
    fleet.setpoint[who] = setpoints[who]
    fleet.repeat_us[who] = fleet.time_us[who]


def advance(vehicles: Vehicles, ticks: Times, rates: RateSetpoints | None) -> None:
    """Fly each vehicle for so many ticks (n,), by velocities or `rates`."""
    if rates is not None:
        rates.advance(vehicles, ticks)
    else:
        vehicles.advance(ticks)


def ticks_of(time_us: Times) -> Times:
    """Round times [µs] to whole ticks."""
    ticks: Times = (time_us + TICK_US // 2) // TICK_US
    return ticks
