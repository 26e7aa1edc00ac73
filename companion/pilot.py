"""Decision loop and mission: arm, take off, fly the policy, land; or take over from a pilot.

The loop observes, infers, acts and holds, with a time stamp at every step.

Decisions are sequential, as in the paper, or pipelined: without a hold, the next decision begins as
soon as the previous one is ready. The last command stays in effect while a decision is computed.
With latency compensation, the policy sees the state predicted for the time its action is sent.
"""

from __future__ import annotations

import math
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Event
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from airl_mav.core import constants, errors
from airl_mav.core.clock import Clock
from airl_mav.core.frames import Goal, goal_distance_m
from airl_mav.latency import injection, stamps
from airl_mav.policy import actions, observation_spec
from airl_mav.policy.observation import Kinematics, Observation, observe, views_of
from airl_mav.prediction import Compensator, DecisionMemory
from airl_mav.scenario import model, stand_alone
from companion import link_interface
from companion.frame_source import FrameSource, ReceivedFrame
from companion.limits import NOT_OURS, Limits, with_time_limit
from companion.mavsdk_connection import ARDUPILOT
from companion.mavsdk_link import MavsdkLink
from companion.watchdog import Guard, Watchdog

if TYPE_CHECKING:
    from airl_mav.profiles.vehicle import VehicleProfile
    from airl_mav.scenario.resolve import ResolvedScenario

FRAME_WAIT_S = 0.1
"""Maximum wait for a frame before the other conditions are checked [s]."""

ONE = np.zeros(1, np.intp)
"""Index of the only companion in its compensator."""

OLDEST_FRAME_US = constants.US_PER_S
"""Maximum frame age [µs]; older or future frames are stamped by another clock."""

WAITING = "waiting for a frame"
"""Stage of a decision, for the watchdog."""


class SentDecision(NamedTuple):
    """Decision whose command was just sent; times in simulated µs."""

    seen: ReceivedFrame
    state: Kinematics
    setpoint: link_interface.Setpoint
    started_us: int
    ready_us: int
    sent_us: int
    held_until_us: int
    held_before_us: int
    """End of the previous decision's hold; `NO_STAMP` for the first decision."""
    expires_us: int | None
    """Time when the velocity is zeroed without another decision; None = never."""
    image: NDArray[Any]
    """Image given to the policy, as `Frame.image`, with latency compensation if enabled."""


@dataclass
class Pilot:
    """Pilot that flies a policy to a goal."""

    link: link_interface.PilotLink
    frames: FrameSource
    policy: actions.Policy
    watchdog: Watchdog
    clock: Clock
    settings: model.PilotSettings
    latency: injection.LatencySampler | None = None
    """Sampler of the inference time t2, to emulate a slower computer; None = no injection."""
    compensator: Compensator | None = None
    """Latency compensation of image and state, for one companion; None = no compensation."""
    limits: Limits | None = None
    """Plausibility and flight limits; None = no limits."""
    decided: Callable[[SentDecision], None] | None = None
    """Callback for every decision, called when its setpoint is sent. Must not block."""
    memory: DecisionMemory = field(init=False)
    """Setpoints and latencies so far."""
    earlier: deque[tuple[NDArray[Any], Kinematics]] = field(
        default_factory=lambda: deque(maxlen=observation_spec.MOST_FRAMES - 1), init=False
    )
    """Images and states of earlier decisions, newest first."""
    further: deque[dict[str, NDArray[Any]]] = field(
        default_factory=lambda: deque(maxlen=observation_spec.MOST_FRAMES - 1), init=False
    )
    """Images of additional cameras in earlier decisions, by name."""
    log: stamps.DecisionLog = field(init=False)
    held_us: int = field(default=stamps.NO_STAMP, init=False)

    def __post_init__(self) -> None:
        """Create the decision log and memory; a compensator's memory is shared."""
        self.log = stamps.DecisionLog(commands=self.settings.commands)
        compensator = self.compensator
        self.memory = DecisionMemory(1) if compensator is None else compensator.memory

    def fly(self, goal: Goal, stop: Event) -> str:
        """Decide until the goal is reached or the flight ends; return the reason as text."""
        sequence = -1
        # Limits count from the start of navigation.
        if self.limits is not None:
            self.limits.begin(self.clock.time_us())
        self.earlier.clear()
        self.further.clear()
        # Compensation has its own memory of sent setpoints.
        if self.compensator is not None:
            self.compensator.begin(0)
        else:
            self.memory.begin(0)
        while not stop.is_set():
            if not self.link.connected:
                return "link lost"
            if self.watchdog.left_offboard:
                return "watchdog"
            # The watchdog names this stage if no frame arrives.
            self.watchdog.doing(WAITING)
            received = self.frames.wait(newer_than_sequence=sequence, timeout_s=FRAME_WAIT_S)
            state = self.link.kinematics()
            # Check limits without a new frame too: telemetry may be wrong between frames.
            if (reason := self._broken(state, received)) is not None:
                return reason
            if received is None:
                continue
            sequence = received.frame.sequence
            # The goal is checked per frame, at the rate of decisions.
            if goal_distance_m(goal, state.position) < self.settings.goal_radius_m:
                return "goal reached"
            if (reason := self._decide(received, state, goal, stop)) is not None:
                return reason
        return "stopped"

    def _broken(self, state: Kinematics, seen: ReceivedFrame | None) -> str | None:
        """Return the broken limit that ends the flight, as text; None = no limit broken."""
        if self.limits is None:
            return None
        if self.watchdog.left_offboard:
            return "watchdog"  # the watchdog has changed the mode
        ending = self.limits.broken(self.link.status(), state, seen, self.clock.time_us())
        return None if ending is None else ending.reason

    def _decide(
        self, seen: ReceivedFrame, state: Kinematics, goal: Goal, stop: Event
    ) -> str | None:
        """Run one decision; return the reason if the flight has ended, as text."""
        clock, settings = self.clock, self.settings
        self.watchdog.doing("inference")
        # Sampled before the start stamp: the draw is not part of the inference time.
        lasts_us = None if self.latency is None else self.latency.sample_us()
        started_us = clock.time_us()
        observation = self._observe(seen, state, goal, started_us)
        action = actions.flyable(
            self.policy.act(observation), settings.commands, settings.max_speed_m_s
        )
        if lasts_us is not None:
            # Not interruptible, like a real computation.
            clock.sleep_until(started_us + lasts_us)
        ready_us = clock.time_us()
        # The vertical speed uses the newest position, not that of the frame.
        setpoint = self._setpoint(action)
        hold_us = int(settings.hold_s * constants.US_PER_S)
        sent_us = clock.time_us()
        if stop.is_set():
            return None
        # During the inference, the watchdog may have left offboard, or a pilot taken over.
        if self.watchdog.left_offboard:
            return "watchdog"
        limits = self.limits
        if limits is not None and (ending := limits.not_ours(self.link.status(), sent_us)):
            return ending.reason
        # `command` sends and feeds the watchdog under one lock.
        if not self.watchdog.command(setpoint, hold_us):
            return "watchdog"
        hover_s = self.watchdog.hover_after_s
        expires_us = None if hover_s is None else sent_us + hold_us + hover_s * constants.US_PER_S
        if self.decided is not None:
            # A pipelined decision has no hold: the next one starts at once.
            held_us = sent_us + (hold_us if settings.decisions == "sequential" else 0)
            times = started_us, ready_us, sent_us, held_us, self.held_us
            until_us = None if expires_us is None else int(expires_us)
            self.decided(SentDecision(seen, state, setpoint, *times, until_us, observation.image))
        t2_us = np.array([ready_us - started_us])
        # Exactly one of the two memories records the setpoint.
        if self.compensator is None:
            self.memory.decided(ONE, np.array([setpoint]), t2_us)
        else:
            self.compensator.decided(
                ONE,
                np.array([setpoint]),
                t2_us,
                np.array([sent_us]),
                None if expires_us is None else np.array([expires_us]),
            )
        # Interruptible by `stop`, unlike the inference.
        if settings.decisions == "sequential":
            self.watchdog.doing("holding an action")
            clock.sleep_until(sent_us + hold_us, stop)
        self.held_us = clock.time_us()
        self.log.record(
            seen.frame.capture_time_us,
            seen.received_us,
            started_us,
            ready_us,
            sent_us,
            self.held_us,
            setpoint,
        )
        return None

    def _setpoint(self, action: actions.AnyAction) -> link_interface.Setpoint:
        if not isinstance(action, actions.Action):
            return action
        down = action.down_m_s
        if down is None:
            # Vertical speed for altitude hold.
            now_m = float(self.link.kinematics().position[2])
            down = actions.vertical_speed(self.settings.altitude_m, now_m)
        return link_interface.BodyVelocity(
            action.forward_m_s, action.right_m_s, down, action.yaw_rate_rad_s
        )

    def _observe(
        self, seen: ReceivedFrame, state: Kinematics, goal: Goal, now_us: int
    ) -> Observation:
        frame, image = seen.frame, seen.frame.image
        age_us = np.array([age_of(seen, now_us)])
        # Compensation replaces image and state by those predicted for the time of the action.
        if self.compensator is not None:
            images, states = self.compensator.foresee(
                ONE, image[None], age_us, np.array([now_us]), state.rows(None)
            )
            image, state = images[0], states.rows(0)
        told = self.memory.in_flight(age_us).rows(0)
        # Copied before the current image joins the queue.
        earlier = tuple(self.earlier)
        views = views_of(frame, self.further)
        self.earlier.appendleft((image, state))
        self.further.appendleft({name: each.image for name, each in views.items()})
        return observe(
            *(image, frame.intrinsics, state, np.asarray(goal, np.float64)),
            told,
            earlier,
            views,
        )


def age_of(seen: ReceivedFrame, now_us: int) -> int:
    """Return a frame's age [µs]; the time since its arrival if stamped by another clock."""
    age_us = now_us - seen.frame.capture_time_us
    return age_us if 0 <= age_us <= OLDEST_FRAME_US else now_us - seen.received_us


PREPARE_TIMEOUT_S = 10.0
"""Maximum silence of the flight controller at the start of a mission [wall s]."""

HOVER_TIMEOUT_S = 5.0
TAKEOFF_TIMEOUT_S = 30.0
LAND_TIMEOUT_S = 60.0

REFEREE_S = 10.0
"""Time from a rehearsal's time limit to the companion's [s]: the referee's order may be late."""

FRAME_TIMEOUT_S = 5.0
"""Timeout of the first camera frame [wall s]."""


Start: TypeAlias = stand_alone.Start | Literal["hover"]
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
    log: stamps.DecisionLog


@dataclass(frozen=True)
class Mission:
    """Goal, policy and settings of a mission."""

    goal: Goal
    """North, east of the start [m], and down if it has a height."""
    policy: actions.Policy
    pilot: model.PilotSettings
    watchdog: model.WatchdogSettings
    limits: model.LimitSettings
    latency: injection.LatencySampler | None = None
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
        policy: actions.Policy,
        latency: injection.LatencySampler | None,
        compensator: Compensator | None,
    ) -> Mission:
        """Return the mission of a scenario to a goal."""
        asked, pilot = scenario.scenario, scenario.companion_pilot
        return cls(
            goal,
            policy,
            pilot,
            scenario.watchdog,
            # The referee's time limit comes first.
            with_time_limit(asked.limits, goal, pilot, asked.time_limit_s + REFEREE_S),
            latency,
            compensator,
            mount_of(scenario.vehicle),
            start="hover" if asked.start == "hover" else "arm",
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
    speed = getattr(clock, "speed", 1.0)  # Simulated clocks do not depend on the host.
    limits = Limits(mission.limits, mission.goal, settings, mission.mount_rad, speed)
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
        _begin(link, start, settings, stop, progress, limits, clock)
        progress("navigating")
        # The watchdog starts before its guard, so that the first deadline counts from here.
        watchdog.begin()
        guard.start(watchdog)
        navigating = True
        reason = pilot.fly(mission.goal, stop)
    except link_interface.LinkError as error:
        reason = str(error)
    except Exception as error:
        # A policy may raise any exception; the vehicle must still land.
        reason = actions.failure_of(error)
        traceback.print_exc(file=sys.stderr)
    finally:
        guard.stop()
    lost = not link.connected
    if abandon.is_set():
        reason = "stopped"
    elif lost:
        # The watchdog may have noticed the lost link first.
        reason = link_interface.LINK_LOST
    elif reason == "watchdog" and watchdog.culprit == WAITING:
        reason = link_interface.CAMERA_SILENT
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
        elif abandon.is_set() or lost or reason == link_interface.TELEMETRY_FROZEN:
            # A link may be lost in one direction only: MAVSDK must stop repeating the last
            # setpoint to a vehicle that still receives it.
            link.leave_offboard()
        # With a working link the vehicle lands, or is handed back where a pilot started the
        # mission.
        if not (taken or abandon.is_set() or lost):
            left = watchdog.left_offboard or reason == link_interface.TELEMETRY_FROZEN
            if start == "arm":
                _land(link, left, progress)
            elif navigating and not left:
                progress("handing back")
                link.send_setpoint(link_interface.STOP)
                link.leave_offboard()
    except link_interface.LinkError as error:
        notes.append(str(error))
        if reason == link_interface.TELEMETRY_FROZEN:
            # No reply: the link is silent, which MAVSDK detects only after 3 s.
            reason = link_interface.LINK_LOST
    progress("done")
    return MissionResult(reason, tuple(notes), pilot.log)


def _begin(
    link: MavsdkLink,
    start: Start,
    settings: model.PilotSettings,
    stop: threading.Event,
    progress: Callable[[str], None],
    limits: Limits,
    clock: Clock,
) -> None:
    """Wait until the vehicle flies the companion's setpoints. Raises LinkError."""

    def watch(state: Kinematics) -> None:
        if (ending := limits.watch(state, clock.time_us())) is not None:
            raise link_interface.LinkError(ending.reason)

    progress(FIRST_PHASE[start])
    link.prepare(PREPARE_TIMEOUT_S, stop)
    # Checked after `prepare`, which detects the kind of flight controller.
    if settings.commands != "velocity" and link.dialect is ARDUPILOT:
        # GUIDED mode interprets thrust as climb rate, unless changed by GUID_OPTIONS.
        words = settings.commands.replace("_", " ")
        raise link_interface.LinkError(
            f"the policy commands {words}, which only PX4 flies with its thrust"
        )
    if start == "offboard":
        link.await_offboard(stop)
        return
    if start == "hover":
        # A hovering vehicle has its position and height: arming and take-off are skipped.
        link.await_hover(settings.altitude_m, HOVER_TIMEOUT_S, stop)
        link.enter_offboard()
        return
    link.arm(link.dialect.arm_timeout_s, stop, settings.origin, watch)
    progress("taking off")
    link.takeoff(settings.altitude_m, TAKEOFF_TIMEOUT_S, stop, watch)
    link.enter_offboard()


def _land(link: MavsdkLink, left_offboard: bool, progress: Callable[[str], None]) -> None:
    progress("landing")
    if not left_offboard:
        link.send_setpoint(link_interface.STOP)
    link.land(LAND_TIMEOUT_S)


def check_camera(
    policy: actions.Policy,
    frames: FrameSource,
    stop: threading.Event,
    compensator: Compensator | None = None,
) -> None:
    """Check the first frame, if any before `stop`; UsageError if the policy cannot use it."""
    # Only policies bound to a camera, and compensation, depend on the frame's size.
    if not isinstance(policy, actions.CameraBound) and compensator is None:
        return
    # Short waits, so that `stop` ends the check early.
    for _ in range(math.ceil(FRAME_TIMEOUT_S / FRAME_WAIT_S)):
        received = frames.wait(newer_than_sequence=-1, timeout_s=FRAME_WAIT_S)
        if received is None:
            if stop.is_set():
                return
            continue
        camera = received.frame.intrinsics
        if (
            isinstance(policy, actions.CameraBound)
            and (reason := policy.refuses(camera)) is not None
        ):
            raise errors.UsageError(f"--policy {policy.name}: {reason}")
        lenses = received.frame.lenses
        if (
            isinstance(policy, actions.RigBound)
            and (reason := policy.refuses_further(lenses)) is not None
        ):
            raise errors.UsageError(f"--policy {policy.name}: in the frames that come: {reason}")
        if compensator is not None and camera != compensator.intrinsics:
            raise errors.FieldError(
                "compensate",
                True,
                problem=f"the camera is {camera}; accepted: that of the vehicle's profile,"
                f" {compensator.intrinsics}",
            )
        return
