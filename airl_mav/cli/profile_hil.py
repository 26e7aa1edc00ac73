"""`airl profile --level hil`: on the drone's computer, against a simulator elsewhere."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable

import numpy as np

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.cli.companion_command import (
    CompanionCommand,
    PilotOptions,
    check,
    load,
    opened,
    watchdog_settings,
)
from airl_mav.cli.profile_bare import typical_us
from airl_mav.cli.profile_plan import Measured, ProfilePlan
from airl_mav.clock import WallClock
from airl_mav.latency.stamps import STAMPS
from airl_mav.policy.actions import Action, CameraBound, Policy
from airl_mav.policy.observation import Observation
from companion.guard import ThreadGuard
from companion.link import LinkError
from companion.mission import check_camera, fly_mission

PACE_M_S = 0.1
FAR_M = 9_000.0
"""Where the goal is, north of the start [m]: out of reach."""

UNRELATED = ("capture_us",)
"""Stamps by the simulator's clock, which nothing relates to this computer's."""


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

    before = {
        number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)
    }
    policy = Counted(load(command, pilot), asked.warm_up + asked.decisions, stop, progress)
    try:
        with opened(command, clock, abandon) as (link, frames):
            link.connect(command.connect_timeout, stop)
            check_camera(policy, frames, stop)
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
    except LinkError:
        if interrupted.is_set():
            raise KeyboardInterrupt from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if interrupted.is_set():
        raise KeyboardInterrupt
    columns = result.log.columns()
    if len(result.log) < asked.warm_up + asked.decisions:
        raise LinkError(f"{result.reason} after {len(result.log)} decisions: too few")
    stamps = {
        name: np.asarray(columns[name][asked.warm_up :], np.int64)
        for name in STAMPS
        if name not in UNRELATED
    }
    return Measured(
        flights=(stamps,),
        seen="decoded_us",
        load_us=load_us,
        first_us=first_us,
        remarks=(
            f"in flight against a simulator elsewhere, hold {plan.hold_s:g} s and at most "
            f"{PACE_M_S:g} m/s: timing was measured, not flying well",
            "t1, link, control and end to end were not measured (-): nothing relates the "
            "simulator's clock to this computer's",
        ),
    )
