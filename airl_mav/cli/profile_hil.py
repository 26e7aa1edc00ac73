"""`airl profile --level hil`: on the drone's computer, against a simulator elsewhere."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.cli.companion_command import (
    CompanionCommand,
    PilotOptions,
    check,
    load,
    open_camera,
    watchdog_settings,
)
from airl_mav.cli.profile_bare import typical_us
from airl_mav.cli.profile_plan import Measured, ProfilePlan
from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_MS
from airl_mav.latency.clock_offset import ClockError, ClockRelation, Exchanges, relate
from airl_mav.latency.stamps import STAMPS
from airl_mav.policy.actions import Action, CameraBound, Policy
from airl_mav.policy.observation import Observation
from companion.guard import ThreadGuard
from companion.interfaces import LinkError
from companion.mission import MissionResult, check_camera, fly_mission
from companion.timesync import TimesyncLink

PACE_M_S = 0.1
FAR_M = 9_000.0
"""Where the goal is, north of the start [m]: out of reach."""

ROW_EXCHANGES = 100
"""TIMESYNC exchanges in a row, before the flight and after it."""

ROW_INTERVAL_S = 0.005
"""From one of them to the next [s]: out of step with the simulator's tick soon enough."""

FLIGHT_INTERVAL_S = 0.1
"""From one exchange in flight to the next [s]. Each takes 0.3 ms of processor time on a desktop
core, and one or two decisions of a hundred fall together with one."""

Stamps = dict[str, NDArray[np.int64]]


@dataclass(frozen=True)
class Flown:
    """A flight, and what was heard of the simulator's clock."""

    result: MissionResult
    before: Exchanges
    between: Exchanges
    after: Exchanges


class Counted:
    """A policy that ends the flight after so many decisions. Implements `actions.Policy`."""

    def __init__(
        self, policy: Policy, most: int, stop: threading.Event, progress: Callable[[int], None]
    ) -> None:
        self._policy, self._most = policy, most
        self._stop, self._progress = stop, progress
        self._count = 0

    @property
    def name(self) -> str:
        """Name of the policy."""
        return self._policy.name if isinstance(self._policy, CameraBound) else ""

    def refuses(self, camera: Intrinsics) -> str | None:
        """Return why a camera cannot serve the policy."""
        return self._policy.refuses(camera) if isinstance(self._policy, CameraBound) else None

    def act(self, observation: Observation) -> Action:
        """Return the policy's action."""
        # Stopped before the decision, not after: the pilot drops the one that it is stopped in.
        if self._count == self._most:
            self._stop.set()
        else:
            self._count += 1
            self._progress(self._count)
        return self._policy.act(observation)


def measure(plan: ProfilePlan, progress: Callable[[int], None]) -> Measured:
    """Fly until there are enough decisions.

    Args:
        plan: What is measured.
        progress: Called with the number of decisions so far.

    Raises:
        UsageError: It cannot be flown as asked.
        LinkError: The flight ended before there were enough decisions.
        KeyboardInterrupt: Ctrl-C; the vehicle has been asked to land.
    """
    asked = plan.command
    command = CompanionCommand(
        goal=(FAR_M, 0.0),
        policy=plan.policy,
        runtime=asked.runtime,
        threads=asked.threads,
        connect=asked.connect,
        camera=asked.camera,
        seed=asked.seed,
        pilot=PilotOptions(hold_s=plan.hold_s, goal_radius_m=0.5, max_speed_m_s=PACE_M_S),
    )
    pilot = check(command)
    load_us, first_us, _ = typical_us(plan)
    clock = WallClock()
    stop, abandon, interrupted = threading.Event(), threading.Event(), threading.Event()

    def interrupt(*_: object) -> None:
        interrupted.set()
        stop.set()

    handlers = {
        number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)
    }
    policy = Counted(load(command, pilot), asked.warm_up + asked.decisions, stop, progress)
    try:
        with (
            closing(open_camera(command.camera, clock)) as frames,
            closing(TimesyncLink(command.connect, clock, abandon)) as link,
        ):
            link.connect(command.connect_timeout, stop)
            check_camera(policy, frames, stop)
            link.exchange(ROW_EXCHANGES, ROW_INTERVAL_S, stop)
            before = link.take_exchanges()
            with link.exchanging(FLIGHT_INTERVAL_S):
                result = fly_mission(
                    link,
                    frames,
                    policy,
                    command.goal,
                    clock,
                    stop,
                    abandon,
                    lambda _: None,
                    pilot_settings=pilot,
                    watchdog_settings=watchdog_settings(command),
                    guard=ThreadGuard(clock),
                )
            between = link.take_exchanges()
            # `stop` is set by now: it ends the flight.
            link.exchange(ROW_EXCHANGES, ROW_INTERVAL_S, interrupted)
            flown = Flown(result, before, between, link.take_exchanges())
    except LinkError:
        if interrupted.is_set():
            raise KeyboardInterrupt from None
        raise
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if interrupted.is_set():
        raise KeyboardInterrupt
    if len(result.log) < asked.warm_up + asked.decisions:
        raise LinkError(f"{result.reason} after {len(result.log)} decisions: too few")
    stamps, seen, remarks = joined(flown, asked.warm_up)
    return Measured(
        flights=(stamps,),
        seen=seen,
        load_us=load_us,
        first_us=first_us,
        remarks=(
            f"in flight against a simulator elsewhere, hold {plan.hold_s:g} s and at most "
            f"{PACE_M_S:g} m/s: timing was measured, not flying well",
            *remarks,
        ),
    )


def joined(flown: Flown, warm_up: int) -> tuple[Stamps, str, tuple[str, ...]]:
    """Bring the exposure of the frames to this computer's clock, if that can be done.

    Returns:
        Columns of the decisions after the warm-up, and `exchange_*` ones, a row an exchange in
        flight; the stamp at which what a decision rests on was seen; what is to be said of it.
        `capture_simulator_us` is the exposure by the simulator's clock, `capture_us` by this
        computer's, within `capture_uncertainty_us`.
    """
    columns = flown.result.log.columns()
    stamps = {name: np.asarray(columns[name][warm_up:], np.int64) for name in STAMPS}
    exposed_us = stamps.pop("capture_us")
    between = flown.between
    flying = between.sent_us >= stamps["infer_start_us"][0]
    flying &= between.received_us <= stamps["held_until_us"][-1]
    exchanges = {
        "exchange_sent_us": between.sent_us[flying],
        "exchange_simulator_us": between.remote_us[flying],
        "exchange_received_us": between.received_us[flying],
    }
    try:
        relation = relate(flown.before, between, flown.after)
        related = _exposures(exposed_us, stamps["decoded_us"], relation)
    except ClockError as error:
        remark = (
            "t1, link, control and end to end were not measured (-): nothing relates the "
            f"simulator's clock to this computer's: {error}"
        )
        return {**stamps, **exchanges}, "decoded_us", (remark,)
    remarks = (
        _relation_remark(flown, relation, int(related["capture_uncertainty_us"].max())),
        "link, control and end to end were not measured (-): the autopilot tells only 10 times a "
        "second what it flies; a setpoint's way there is a part of the MAVLink round trip",
    )
    return {**related, **stamps, **exchanges}, "capture_us", remarks


def _exposures(
    exposed_us: NDArray[np.int64], decoded_us: NDArray[np.int64], relation: ClockRelation
) -> Stamps:
    """Return the exposures by this computer's clock.

    Raises:
        ClockError: A frame would have been decoded before it was exposed.
    """
    captured_us = np.rint(relation.own_time(exposed_us)).astype(np.int64)
    # One more for rounding.
    within_us = np.ceil(relation.uncertainty_at(captured_us)).astype(np.int64) + 1
    if (early := int(np.count_nonzero(captured_us - within_us > decoded_us))) > 0:
        raise ClockError(
            f"{early} frames would have been decoded before they were exposed: they are stamped "
            "by another clock than the autopilot's, or it was set back"
        )
    return {
        "capture_simulator_us": exposed_us,
        "capture_us": captured_us,
        "capture_uncertainty_us": within_us,
    }


def _relation_remark(flown: Flown, relation: ClockRelation, within_us: int) -> str:
    rows = " and ".join(
        f"{len(row)} exchanges {when} the flight (least round trip "
        f"{row.round_trip_us.min() / US_PER_MS:.3f} ms)"
        for row, when in ((flown.before, "before"), (flown.after, "after"))
    )
    return (
        f"t1 is uncertain by ±{within_us / US_PER_MS:.3f} ms, all decisions alike: the simulator's "
        f"clock was related to this computer's by TIMESYNC, {rows}; it gained "
        f"{relation.drift * 1e6:+.1f} ppm (±{relation.drift_uncertainty * 1e6:.1f}), and "
        f"{relation.agreeing} of {relation.checked} exchanges in flight agree"
    )
