"""Stand-alone companion program: connects, flies one mission and reports the result."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.cpu_quota import held_to
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import Goal
from airl_mav.core.provenance import describe_machine
from airl_mav.flight.episode_record import Part, Setup
from airl_mav.latency.injection import LatencySampler, latency_generator
from airl_mav.policy.actions import Policy
from airl_mav.policy.learned import LearnedPolicy
from airl_mav.policy.registry import camera_refused, find_policy
from airl_mav.prediction import Compensator
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.scenario import piloting
from airl_mav.scenario.model import LimitSettings, PilotSettings, WatchdogSettings
from airl_mav.scenario.stand_alone import StandAloneCompanion, check_companion
from companion.cameras.by_name import OpenCamera, open_named_camera
from companion.frame_source import FrameSource, SharedFrames
from companion.mavsdk_link import MavsdkLink
from companion.offboard_mission import MissionResult, check_camera, fly_mission
from companion.presence import obstacles_told, present
from companion.signing_proxy import signed
from companion.watchdog import ThreadGuard

if TYPE_CHECKING:
    from companion.black_box import BlackBoxRecorder

_SETUP = TypeAdapter(Setup)

FLIGHT_S = 600.0
"""Default time limit of navigation [s]."""


@dataclass(frozen=True)
class MissionSetup:
    """Goal, policy and settings of a mission."""

    goal: Goal
    """North, east of the start [m]."""
    policy: Policy
    pilot: PilotSettings
    watchdog: WatchdogSettings
    limits: LimitSettings
    latency: LatencySampler | None
    """Sampler of the inference time t2; None = no injection."""
    compensator: Compensator | None
    """Latency compensation of image and state; None = no compensation."""
    vehicle: VehicleProfile
    """Vehicle profile, with the camera and its mounting."""
    setup: Setup

    @property
    def mount_pitch_up_rad(self) -> float:
        """Mounting angle of the camera above the nose [rad]."""
        return math.radians(self.vehicle.camera.pitch_up_deg)

    @property
    def mount_yaw_rad(self) -> float:
        """Mounting angle of the camera to the right of the nose [rad]."""
        return math.radians(self.vehicle.camera.yaw_deg)


def prepare(asked: StandAloneCompanion) -> MissionSetup:
    """Check the input and load the policy before any connection, or raise UsageError."""
    check_companion(asked)
    policy = find_policy(asked.policy, trust=asked.trust)
    pilot, watchdog = piloting.decide_piloting(asked, policy, PilotSettings.goal_radius_m)
    # Computing time of this computer counts, except in lockstep.
    injection = piloting.select_latency(asked, policy, on_this_computer=not asked.lockstep)
    piloting.check_quota(asked, injection, "lockstep" if asked.lockstep else "sitl")
    loaded = piloting.load_asked_policy(asked, policy, pilot.hold_s, asked.seed)
    sampler = injection.sampler(latency_generator(asked.seed, asked.latency_seed))
    # Obstacle messages need depth along the heading; other cameras are rejected before the flight.
    vehicle, compensator = load_vehicle(asked.vehicle), None
    needs = {
        "gives depth": vehicle.camera.kind == "depth",
        "is a pinhole or a cylinder": vehicle.camera.projection != "fisheye",
        "looks ahead (camera.yaw_deg = 0)": vehicle.camera.yaw_deg == 0.0,
    }
    for need, met in needs.items():
        if asked.tell_obstacles and not met:
            accepted = f"with a vehicle whose camera {need}"
            raise FieldError("tell_obstacles", asked.tell_obstacles, accepted)
    # A policy with a card is checked against the camera's first frame, before take-off.
    if policy.card is None and (reason := camera_refused(policy, vehicle)):
        raise FieldError(
            "policy", asked.policy, problem=f"does not fit vehicle {asked.vehicle}: {reason}"
        )
    piloting.check_goal_height(
        policy, asked.goal, "goal", " ".join(f"{metres:g}" for metres in asked.goal)
    )
    # Checked before the compensator is created.
    piloting.check_compensated(pilot, policy, vehicle)
    if pilot.compensate:
        compensator = Compensator(1, vehicle, Intrinsics.of(vehicle.camera))
    limits = asked.limits
    # A stand-alone flight always has a time limit.
    if limits.flight_s is None:
        limits = limits.model_copy(update={"flight_s": FLIGHT_S})
    computer = Part(asked.computer, load_computer(asked.computer).description)
    # Without injection the inference runs at this computer's speed.
    if injection.latency is None:
        computer = Part("this computer", f"{describe_machine()['cpu']}")
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
        between_commands=piloting.between_commands(pilot, watchdog.hover_after_s),
        firmware="not known",
    )
    return MissionSetup(
        asked.goal,
        loaded,
        pilot,
        watchdog,
        limits,
        sampler,
        compensator,
        vehicle,
        setup,
    )


def mission_camera(asked: StandAloneCompanion, mission: MissionSetup, clock: Clock) -> OpenCamera:
    """Open the requested camera. Raises FieldError if it is unusable."""
    vehicle = mission.vehicle
    policy, cameras = mission.policy, vehicle.cameras
    # Only images that the policy reads are converted.
    if isinstance(policy, LearnedPolicy):
        cameras = {k: v for k, v in cameras.items() if k in policy.card.observation.cameras}
    further = {name: Intrinsics.of(each) for name, each in cameras.items()}
    return open_named_camera(
        *(asked.camera, clock, Intrinsics.of(vehicle.camera), f"vehicle {asked.vehicle}"), further
    )


@contextmanager
def obstacles_reported(
    asked: StandAloneCompanion,
    mission: MissionSetup,
    link: MavsdkLink,
    camera: FrameSource,
    clock: Clock,
) -> Iterator[FrameSource]:
    """Send obstacle distances if requested; yield the frames for the policy."""
    if not asked.tell_obstacles:
        yield camera
        return
    frames, range_m = SharedFrames(camera), mission.vehicle.camera.range_m
    with obstacles_told(link, frames, range_m, mission.mount_pitch_up_rad, clock):
        yield frames


@contextmanager
def recorded(
    asked: StandAloneCompanion, mission: MissionSetup, link: MavsdkLink, clock: Clock
) -> Iterator[BlackBoxRecorder | None]:
    """Record a mission if requested. Raises FieldError if no file can be written."""
    if asked.black_box is None:
        yield None
        return
    # Imported here, as MCAP is an optional extra.
    from companion.black_box import open_recorder, recording

    run = run_of(asked, mission)
    with recording(open_recorder(asked.black_box, run, link, clock, mission.goal)) as recorder:
        link.hear_texts(recorder.heard)
        yield recorder


def run_of(asked: StandAloneCompanion, mission: MissionSetup) -> dict[str, Any]:
    """Return the setup and configuration in the format of `run.json`."""
    config = asked.model_dump(mode="json")
    config |= {"pilot": asdict(mission.pilot), "limits": mission.limits.model_dump(mode="json")}
    return {"setup": _SETUP.dump_python(mission.setup, mode="json"), "config": config}


def fly_alone(
    asked: StandAloneCompanion,
    mission: MissionSetup,
    stop: threading.Event,
    abandon: threading.Event,
    waiting: Callable[[], None],
    progress: Callable[[str, int], None],
) -> MissionResult:
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

    # The order of contexts is the order of closing: the link closes before proxy and camera.
    with (
        held_to(asked.cpu_quota),
        closing(mission_camera(asked, mission, clock)) as camera,
        signed(asked.connect, asked.signing_key) as url,
        closing(MavsdkLink(url, clock, abandon)) as link,
    ):
        waiting()
        link.connect(asked.connect_timeout, stop)
        # The camera is checked before the status messages start, and before take-off.
        check_camera(mission.policy, camera, stop, mission.compensator)
        with (
            present(link, clock),
            obstacles_reported(asked, mission, link, camera, clock) as frames,
            recorded(asked, mission, link, clock) as box,
        ):
            result = fly_mission(
                *(link, frames, mission.policy, mission.goal, clock, stop, abandon, begin),
                pilot_settings=mission.pilot,
                watchdog_settings=mission.watchdog,
                limit_settings=mission.limits,
                guard=ThreadGuard(clock),
                latency=mission.latency,
                compensator=mission.compensator,
                mount_pitch_up_rad=mission.mount_pitch_up_rad,
                mount_yaw_rad=mission.mount_yaw_rad,
                start=asked.start,
                decided=None if box is None else box.decided,
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
