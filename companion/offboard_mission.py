"""Mission: arm, take off, fly the policy, land; or take over from a pilot and hand back."""

from __future__ import annotations

import math
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

from airl_mav.core.clock import Clock
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.frames import Goal
from airl_mav.latency.injection import LatencySampler
from airl_mav.latency.stamps import DecisionLog
from airl_mav.policy.actions import CameraBound, Policy, RigBound
from airl_mav.prediction import Compensator
from airl_mav.scenario.model import LimitSettings, PilotSettings, WatchdogSettings
from airl_mav.scenario.stand_alone import Start as PilotedStart
from companion.frame_source import FrameSource
from companion.limits import NOT_OURS, Limits
from companion.link_interface import CAMERA_SILENT, LINK_LOST, STOP, TELEMETRY_FROZEN, LinkError
from companion.mavsdk_connection import ARDUPILOT
from companion.mavsdk_link import MavsdkLink
from companion.pilot import FRAME_WAIT_S, WAITING, Pilot, SentDecision
from companion.watchdog import Guard, Watchdog

if TYPE_CHECKING:
    from airl_mav.profiles.vehicle import VehicleProfile
    from airl_mav.scenario.resolve import ResolvedScenario

PREPARE_TIMEOUT_S = 10.0
"""Maximum silence of the flight controller at the start of a mission [wall s]."""

HOVER_TIMEOUT_S = 5.0
TAKEOFF_TIMEOUT_S = 30.0
LAND_TIMEOUT_S = 60.0

FRAME_TIMEOUT_S = 5.0
"""Timeout of the first camera frame [wall s]."""


Start: TypeAlias = PilotedStart | Literal["hover"]
"""Start of a mission; hover = in Hold in the air, where the companion enters offboard."""

FIRST_PHASE: dict[Start, str] = {
    "arm": "arming",
    "offboard": "waiting for offboard",
    "hover": "entering offboard",
}


@dataclass(frozen=True)
class MissionResult:
    """Result of a mission."""

    reason: str
    """Reason of the end: goal reached, stopped, link lost, camera silent, watchdog, the broken
    limit (`limits.py`), or the rejected or failed request."""
    notes: tuple[str, ...]
    """Actions of the watchdog, the broken limit, failures during the landing."""
    log: DecisionLog


@dataclass(frozen=True)
class Mission:
    """Goal, policy and settings of a mission."""

    goal: Goal
    """North, east of the start [m], and down if it has a height."""
    policy: Policy
    pilot: PilotSettings
    watchdog: WatchdogSettings
    limits: LimitSettings
    latency: LatencySampler | None = None
    """Sampler of the inference time t2; None = no injection."""
    compensator: Compensator | None = None
    """Latency compensation of image and state; None = no compensation."""
    mount_rad: tuple[float, float] = (0.0, 0.0)
    """Mounting angles of the camera, up and to the right of the nose [rad]."""
    start: Start = "arm"

    @classmethod
    def of(
        cls,
        scenario: ResolvedScenario,
        goal: Goal,
        policy: Policy,
        latency: LatencySampler | None,
        compensator: Compensator | None,
    ) -> Mission:
        """Return the mission of a scenario to a goal."""
        return cls(
            goal,
            policy,
            scenario.companion_pilot,
            scenario.watchdog,
            scenario.scenario.limits,
            latency,
            compensator,
            mount_of(scenario.vehicle),
            start="hover" if scenario.scenario.start == "hover" else "arm",
        )


def mount_of(vehicle: VehicleProfile) -> tuple[float, float]:
    """Return the camera's mounting angles, up and to the right of the nose [rad]."""
    return math.radians(vehicle.camera.pitch_up_deg), math.radians(vehicle.camera.yaw_deg)


def fly_mission(
    link: MavsdkLink,
    frames: FrameSource,
    mission: Mission,
    clock: Clock,
    stop: threading.Event,
    abandon: threading.Event,
    progress: Callable[[str], None],
    guard: Guard,
    decided: Callable[[SentDecision], None] | None = None,
) -> MissionResult:
    """Fly one mission on a connected link; failures of a flight do not raise.

    `stop`, set externally, lands early; `abandon`, the link's event, ends without landing after a
    crash. `progress` receives the name of each phase at its start; `decided` must not block.
    """
    settings, start = mission.pilot, mission.start
    watchdog = Watchdog(link, clock, mission.watchdog)
    navigating = False
    limits = Limits(mission.limits, mission.goal, settings, mission.mount_rad)
    pilot = Pilot(
        link,
        frames,
        mission.policy,
        watchdog,
        clock,
        settings,
        mission.latency,
        mission.compensator,
        limits,
        decided,
    )
    # From here on the vehicle may fly: every way out passes through the landing below.
    try:
        _begin(link, start, settings, stop, progress)
        progress("navigating")
        # The watchdog starts before its guard, so that the first deadline counts from here.
        watchdog.begin()
        guard.start(watchdog)
        navigating = True
        reason = pilot.fly(mission.goal, stop)
    except LinkError as error:
        reason = str(error)
    except Exception as error:
        # A policy may raise any exception; the vehicle must still land.
        reason = f"policy failed: {type(error).__name__}: {error}"
        traceback.print_exc(file=sys.stderr)
    finally:
        guard.stop()
    lost = not link.connected
    if abandon.is_set():
        reason = "stopped"
    elif lost:
        # The watchdog may have noticed the lost link first.
        reason = LINK_LOST
    elif reason == "watchdog" and watchdog.culprit == WAITING:
        reason = CAMERA_SILENT
    # The mode decides whether commands may still be sent.
    if navigating and not (watchdog.left_offboard or abandon.is_set()):
        # A pilot may have taken over in the meantime.
        limits.not_ours(link.status(), clock.time_us())
    notes = list(watchdog.notes)
    if limits.ending is not None:
        notes.append(str(limits.ending))
    taken = limits.ending is not None and limits.ending.reason in NOT_OURS
    try:
        # The pilot has the vehicle: the companion only stops sending.
        if taken or (start != "arm" and not navigating):
            # Repeated setpoints must not take effect in a later switch to offboard.
            link.release()
        elif abandon.is_set() or lost or reason == TELEMETRY_FROZEN:
            # A link may be lost in one direction only: MAVSDK must stop repeating the last
            # setpoint to a vehicle that still receives it.
            link.leave_offboard()
        # With a working link the vehicle lands, or is handed back where a pilot started the
        # mission.
        if not (taken or abandon.is_set() or lost):
            left = watchdog.left_offboard or reason == TELEMETRY_FROZEN
            if start == "arm":
                _land(link, left, progress)
            elif navigating and not left:
                progress("handing back")
                link.send_setpoint(STOP)
                link.leave_offboard()
    except LinkError as error:
        notes.append(str(error))
        if reason == TELEMETRY_FROZEN:
            # No reply: the link is silent, which MAVSDK detects only after 3 s.
            reason = LINK_LOST
    progress("done")
    return MissionResult(reason, tuple(notes), pilot.log)


def _begin(
    link: MavsdkLink,
    start: Start,
    settings: PilotSettings,
    stop: threading.Event,
    progress: Callable[[str], None],
) -> None:
    """Wait until the vehicle flies the companion's setpoints. Raises LinkError."""
    progress(FIRST_PHASE[start])
    link.prepare(PREPARE_TIMEOUT_S, stop)
    # Checked after `prepare`, which detects the kind of flight controller.
    if settings.commands != "velocity" and link.dialect is ARDUPILOT:
        # GUIDED mode interprets thrust as climb rate, unless changed by GUID_OPTIONS.
        words = settings.commands.replace("_", " ")
        raise LinkError(f"the policy commands {words}, which only PX4 flies with its thrust")
    if start == "offboard":
        link.await_offboard(stop)
        return
    if start == "hover":
        # A hovering vehicle has its position and height: arming and take-off are skipped.
        link.await_hover(settings.altitude_m, HOVER_TIMEOUT_S, stop)
        link.enter_offboard()
        return
    link.arm(link.dialect.arm_timeout_s, stop, settings.origin)
    progress("taking off")
    link.takeoff(settings.altitude_m, TAKEOFF_TIMEOUT_S, stop)
    link.enter_offboard()


def _land(link: MavsdkLink, left_offboard: bool, progress: Callable[[str], None]) -> None:
    progress("landing")
    if not left_offboard:
        link.send_setpoint(STOP)
    link.land(LAND_TIMEOUT_S)


def check_camera(
    policy: Policy,
    frames: FrameSource,
    stop: threading.Event,
    compensator: Compensator | None = None,
) -> None:
    """Check the first frame, if any before `stop`; UsageError if the policy cannot use it."""
    # Only policies bound to a camera, and compensation, depend on the frame's size.
    if not isinstance(policy, CameraBound) and compensator is None:
        return
    # Short waits, so that `stop` ends the check early.
    for _ in range(math.ceil(FRAME_TIMEOUT_S / FRAME_WAIT_S)):
        received = frames.wait(newer_than_sequence=-1, timeout_s=FRAME_WAIT_S)
        if received is None:
            if stop.is_set():
                return
            continue
        camera = received.frame.intrinsics
        if isinstance(policy, CameraBound) and (reason := policy.refuses(camera)) is not None:
            raise UsageError(f"--policy {policy.name}: {reason}")
        lenses = received.frame.lenses
        if isinstance(policy, RigBound) and (reason := policy.refuses_further(lenses)) is not None:
            raise UsageError(f"--policy {policy.name}: in the frames that come: {reason}")
        if compensator is not None and camera != compensator.intrinsics:
            raise FieldError(
                "compensate",
                True,
                problem=f"the camera is {camera}; accepted: that of the vehicle's profile,"
                f" {compensator.intrinsics}",
            )
        return
