"""Stand-alone companion program: one mission with a real flight controller, or a ground check.

The ground check looks at camera, flight controller and policy for a few seconds, without arming.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core import addons, constants, errors, machine
from airl_mav.core.clock import Clock, WallClock
from airl_mav.flight.episode_record import Part, Setup
from airl_mav.latency.injection import latency_generator
from airl_mav.policy.observation import InFlight, Kinematics, observe, views_of
from airl_mav.policy.registry import LearnedPolicy, camera_refused, find_policy
from airl_mav.prediction import Compensator
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.projections import PROJECTIONS
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.scenario import checks, model, stand_alone
from companion import frame_source, limits, pilot
from companion.link_interface import LinkError
from companion.mavsdk_connection import RATE_HZ
from companion.mavsdk_link import MavsdkLink
from companion.watchdog import ThreadGuard

if TYPE_CHECKING:
    from companion.addons.black_box.recorder import BlackBoxRecorder


@dataclass(frozen=True, kw_only=True)
class MissionSetup(pilot.Mission):
    """Mission of a stand-alone companion."""

    vehicle: VehicleProfile
    """Vehicle profile, with the camera and its mounting."""
    setup: Setup


def prepare(asked: stand_alone.StandAloneCompanion) -> MissionSetup:
    """Check the input and load the policy before any connection, or raise UsageError."""
    stand_alone.check_companion(asked)
    if asked.black_box is not None:
        _recording(asked)
    if asked.tell_obstacles:
        option = "tell_obstacles", True
        addons.load_entry("companion", "REPORTS", "vehicle", option, "vehicle_reports")
    policy = find_policy(asked.policy, trust=asked.trust)
    settings, watchdog = checks.decide_piloting(asked, policy, model.PilotSettings.goal_radius_m)
    # Computing time of this computer counts, except in lockstep.
    injection = checks.select_latency(asked, policy, on_this_computer=not asked.lockstep)
    loaded = checks.load_asked_policy(asked, policy, settings.hold_s, asked.seed)
    sampler = injection.sampler(latency_generator(asked.seed, asked.latency_seed))
    # Obstacle messages need depth along the heading; other cameras are rejected before the flight.
    vehicle, compensator = load_vehicle(asked.vehicle), None
    needs = {
        "gives depth": vehicle.camera.kind == "depth",
        "is a pinhole or a cylinder": not PROJECTIONS[vehicle.camera.projection].tabled,
        "looks ahead (camera.yaw_deg = 0)": vehicle.camera.yaw_deg == 0.0,
    }
    for need, met in needs.items():
        if asked.tell_obstacles and not met:
            accepted = f"with a vehicle whose camera {need}"
            raise errors.FieldError("tell_obstacles", asked.tell_obstacles, accepted)
    # A policy with a card is checked against the camera's first frame, before take-off.
    if policy.card is None and (reason := camera_refused(policy, vehicle)):
        raise errors.FieldError(
            "policy", asked.policy, problem=f"does not fit vehicle {asked.vehicle}: {reason}"
        )
    checks.check_goal_height(
        policy, asked.goal, "goal", " ".join(f"{metres:g}" for metres in asked.goal)
    )
    # Checked before the compensator is created.
    checks.check_compensated(settings, policy, vehicle)
    if settings.compensate:
        compensator = Compensator(1, vehicle, Intrinsics.of(vehicle.camera))
    computer = Part(asked.computer, load_computer(asked.computer).description)
    # Without injection the inference runs at this computer's speed.
    if injection.latency is None:
        computer = Part("this computer", f"{machine.describe_machine()['cpu']}")
    setup = Setup(
        level="flight",
        vehicle=Part(asked.vehicle, vehicle.description),
        arena=Part("an unknown place"),
        policy=Part(policy.name, policy.description),
        computer=computer,
        # The current measured by the flight controller includes the computer.
        computer_watts=0.0,
        injection=injection,
        speed=asked.speed,
        between_commands=checks.between_commands(settings, watchdog.hover_after_s),
        firmware="not known",
    )
    return MissionSetup(
        goal=asked.goal,
        policy=loaded,
        pilot=settings,
        watchdog=watchdog,
        limits=limits.with_time_limit(asked.limits, asked.goal, settings),
        latency=sampler,
        compensator=compensator,
        mount_rad=pilot.mount_of(vehicle),
        start=asked.start,
        vehicle=vehicle,
        setup=setup,
    )


def mission_camera(
    asked: stand_alone.StandAloneCompanion, mission: MissionSetup, clock: Clock
) -> frame_source.OpenCamera:
    """Open the requested camera. Raises FieldError if it is unusable."""
    vehicle = mission.vehicle
    policy, cameras = mission.policy, vehicle.cameras
    # Only images that the policy reads are converted.
    if isinstance(policy, LearnedPolicy):
        cameras = {k: v for k, v in cameras.items() if k in policy.card.observation.cameras}
    further = {name: Intrinsics.of(each) for name, each in cameras.items()}
    wanted, whose = Intrinsics.of(vehicle.camera), f"vehicle {asked.vehicle}"
    key = asked.read_camera_key()
    return frame_source.open_named_camera(asked.camera, clock, wanted, whose, further, key)


def reporting(
    asked: stand_alone.StandAloneCompanion,
    mission: MissionSetup,
    link: MavsdkLink,
    camera: frame_source.OpenCamera,
    clock: Clock,
) -> AbstractContextManager[frame_source.FrameSource]:
    """Send reports to the vehicle's network, if their add-on is there; return the frames to use."""
    place = addons.entries("companion", "REPORTS").get("vehicle")
    if place is None:
        return nullcontext(camera)
    reports: AbstractContextManager[frame_source.FrameSource] = addons.load(place)(
        asked, mission, link, camera, clock
    )
    return reports


def recorded(
    asked: stand_alone.StandAloneCompanion, mission: MissionSetup, link: MavsdkLink, clock: Clock
) -> AbstractContextManager[BlackBoxRecorder | None]:
    """Record a mission if requested. Raises FieldError if no file can be written."""
    if asked.black_box is None:
        return nullcontext()
    recorder: AbstractContextManager[BlackBoxRecorder] = _recording(asked)(
        asked, mission, link, clock
    )
    return recorder


def _recording(asked: stand_alone.StandAloneCompanion) -> Any:
    """Return the function that records a mission. Raises FieldError without the add-on."""
    option = "black_box", f"{asked.black_box}"
    return addons.load_entry("companion", "RECORDERS", "black_box", option, "black_box")


LISTEN_S = 1.2
"""Minimum time to hear all flight controllers of a network [wall s]; heartbeats come at 1 Hz."""


def open_link(
    asked: stand_alone.StandAloneCompanion,
    clock: Clock,
    abandon: threading.Event,
    heard: Callable[[], bool] | None = None,
) -> MavsdkLink:
    """Open the requested link to the flight controller; see `MavsdkLink`. Raises UsageError."""
    return MavsdkLink(
        *(asked.connect, clock, abandon, heard),
        signing_key=asked.signing_key,
        system_id=asked.system_id,
    )


def fly_alone(
    asked: stand_alone.StandAloneCompanion,
    mission: MissionSetup,
    stop: threading.Event,
    abandon: threading.Event,
    waiting: Callable[[], None],
    progress: Callable[[str, int], None],
) -> pilot.MissionResult:
    """Fly one mission with a real flight controller; `stop` lands, `abandon` ends without landing.

    `waiting` is called before waiting for the flight controller. Raises UsageError or LinkError.
    """
    clock = WallClock(asked.speed)

    def begin(phase: str) -> None:
        progress(phase, clock.time_us())
        if box is not None:
            box.phase(phase)
        if phase != "done":
            link.tell(f"airl: {phase}")

    # Reverse order of closing: the link closes before the camera.
    with (
        closing(mission_camera(asked, mission, clock)) as camera,
        closing(open_link(asked, clock, abandon)) as link,
    ):
        waiting()
        link.connect(asked.connect_timeout, stop)
        # The camera is checked before the status messages start, and before take-off.
        pilot.check_camera(mission.policy, camera, stop, mission.compensator)
        link.check_alone(LISTEN_S)
        with (
            reporting(asked, mission, link, camera, clock) as frames,
            recorded(asked, mission, link, clock) as box,
        ):
            decided = None if box is None else box.decided
            result = pilot.fly_mission(
                link, frames, mission, clock, stop, abandon, begin, ThreadGuard(clock), decided
            )
            link.tell(f"airl: {result.reason}")
            # Losses are notes of the result: they need not end the flight.
            if camera.failure is not None:
                result = replace(result, notes=(*result.notes, camera.failure))
            if camera.dropped:
                told = f"{camera.dropped} images of camera {asked.camera} were lost on their way"
                result = replace(result, notes=(*result.notes, told))
            if box is not None:
                box.end(result.reason, result.notes)
                if box.failure is not None:
                    result = replace(result, notes=(*result.notes, box.failure))
            return result


LOOK_S = 3.0
"""Duration of the checks of the camera and of the telemetry [wall s]."""

POLL_S = 0.002
"""Interval of telemetry reads [s]."""

DECISIONS = 30
"""Number of timed decisions, without the first one."""

LEAST_SHARE = 0.5
"""Minimum share of the requested telemetry rate."""


class CheckResult(NamedTuple):
    """Result of one check."""

    what: str
    good: bool
    told: str


def check_on_ground(
    asked: stand_alone.StandAloneCompanion, mission: MissionSetup, stop: threading.Event
) -> Iterator[CheckResult]:
    """Check a flight's requirements one by one, skipping absent parts, until `stop` is set."""
    clock = WallClock(asked.speed)
    yield CheckResult("policy", True, f"{asked.policy}, holds an action {mission.pilot.hold_s:g} s")
    try:
        camera = mission_camera(asked, mission, clock)
    except errors.UsageError as error:
        yield CheckResult("camera", False, str(error))
        return
    with closing(camera):
        yield from look_at_camera(mission, camera, clock, stop)
        # The newest frame serves as input for the timed decisions.
        seen = camera.latest()
        try:
            with closing(open_link(asked, clock, stop)) as link:
                link.connect(asked.connect_timeout, stop)
                link.check_alone(LISTEN_S)
                yield from look_at_vehicle(link, mission, stop)
                if seen is not None and not stop.is_set():
                    yield time_decisions(mission, seen, link.kinematics())
        except (LinkError, errors.UsageError) as error:
            yield CheckResult("flight controller", False, str(error))


def look_at_camera(
    mission: MissionSetup, camera: frame_source.FrameSource, clock: Clock, stop: threading.Event
) -> Iterator[CheckResult]:
    """Check rate, age and changes of frames, and if they fit the policy."""
    first = camera.wait(-1, pilot.FRAME_TIMEOUT_S)
    if first is None:
        yield CheckResult("camera", False, f"no frame for {pilot.FRAME_TIMEOUT_S:g} s")
        return
    try:
        pilot.check_camera(mission.policy, camera, stop, mission.compensator)
    except errors.UsageError as error:
        yield CheckResult("camera", False, str(error))
        return
    # Frames are not stored: a driver may send thousands of large frames.
    watch, last, frozen, ages_us = WallClock(), first, True, []
    # The loop counts changes of frames in wall time: rates of real devices.
    while watch.time_us() < LOOK_S * constants.US_PER_S and not stop.is_set():
        newer = camera.wait(last.frame.sequence, 0.5)
        if newer is not None:
            # Equality with the first frame throughout means a frozen image.
            frozen = frozen and np.array_equal(first.frame.image, newer.frame.image)
            last = newer
            ages_us.append(pilot.age_of(newer, clock.time_us()))
    lens, rate_hz = first.frame.intrinsics, len(ages_us) / LOOK_S
    if not ages_us:
        yield CheckResult("camera", False, f"one frame in {LOOK_S:g} s")
        return
    kind = "" if lens.kind == "depth" else f"{lens.kind}, "
    told = f"{kind}{lens.width}x{lens.height} px, {rate_hz:.1f} frames/s"
    for name, other in first.frame.lenses.items():
        told += f"; {name}: {other.kind}, {other.width}x{other.height} px"
    if frozen:
        # Not a fault: a simulator's images of a vehicle at rest may be without noise.
        told += "; every image is the same (a real camera has noise)"
    age_us = float(np.median(ages_us))
    yield CheckResult(
        "camera", True, f"{told}; {age_us / constants.US_PER_MS:.0f} ms old where it is decided on"
    )


def look_at_vehicle(
    link: MavsdkLink, mission: MissionSetup, stop: threading.Event
) -> Iterator[CheckResult]:
    """Check the telemetry rate, then the reported state."""
    watch, changes, last = WallClock(), 0, link.kinematics()
    while watch.time_us() < LOOK_S * constants.US_PER_S and not stop.is_set():
        watch.sleep_until(watch.time_us() + int(POLL_S * constants.US_PER_S))
        now = link.kinematics()
        # A changed position is the sign of new telemetry.
        changes += not np.array_equal(now.position, last.position)
        last = now
    rate_hz = changes / LOOK_S
    status = link.status()
    yield CheckResult(
        "flight controller",
        link.connected,
        f"{link.dialect.name}, {'armed' if status.armed else 'disarmed'}, mode {status.mode}",
    )
    asked = f"position {rate_hz:.0f} times a second, {RATE_HZ:.0f} were asked for"
    # At least half of the requested rate must arrive.
    yield CheckResult("telemetry", rate_hz >= LEAST_SHARE * RATE_HZ, asked)
    # With an external origin, GPS health is not required.
    missing = link.missing_health(by_gps=mission.pilot.origin is None)
    charge, least = status.battery, mission.limits.battery
    yield CheckResult(
        "battery",
        least is None or (charge is not None and charge >= least),
        ("not told" if charge is None else f"{100.0 * charge:.0f} %")
        + ("" if least is None else f"; the limit is {100.0 * least:g} %"),
    )
    yield CheckResult(
        "health",
        not missing,
        f"not yet: {', '.join(missing)}"
        if missing
        else "calibrated, knows where it is, may be armed",
    )


def time_decisions(
    mission: MissionSetup, seen: frame_source.ReceivedFrame, state: Kinematics
) -> CheckResult:
    """Measure the policy's inference time (t2) on a received frame."""
    frame, watch, took_us = seen.frame, WallClock(), []
    # The same observation each time: only the duration matters.
    observation = observe(
        *(frame.image, frame.intrinsics, state, np.asarray(mission.goal, np.float64)),
        InFlight.of_first_decisions(1).rows(0),
        further=views_of(frame),
    )
    try:
        # One extra call: the first is dropped below.
        for _ in range(DECISIONS + 1):
            begun_us = watch.time_us()
            mission.policy.act(observation)
            took_us.append(watch.time_us() - begun_us)
    except Exception as error:
        # A policy may raise any exception.
        what = " ".join(f"{type(error).__name__}: {error}".split())
        return CheckResult("decision", False, f"the policy failed: {what}")
    del took_us[0]
    median_us = float(np.median(took_us))
    longest_s = max(took_us) / constants.US_PER_S
    bound_s = mission.watchdog.timeout_s()
    return CheckResult(
        "decision",
        longest_s < bound_s,
        f"t2 {median_us / constants.US_PER_MS:.2f} ms, the median of {DECISIONS}; longest"
        f" {1e3 * longest_s:.2f} ms, the watchdog's bound is {bound_s:g} s",
    )
