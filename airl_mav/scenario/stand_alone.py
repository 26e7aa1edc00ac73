"""Settings of the stand-alone programs: vehicle only, and companion only."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from airl_mav.core.constants import LOOPBACK, US_PER_MS, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.core.fields import COMMON, ProfileModel, optional, quantity, switch
from airl_mav.core.frames import Goal
from airl_mav.core.signing import camera_key
from airl_mav.faults import PROCESSES
from airl_mav.flight.judge import TIME_LIMIT_S, GoalRadius, TimeLimit
from airl_mav.scenario import aircraft, checks, model

SPEEDS = 0.0, 100.0
"""Limits of the speed; time beyond the host's capacity is skipped and reported."""

LOCKSTEP_SPEEDS = 0.1, 1000.0
"""Limits of the speed in lockstep; slower, the companion would time out between two turns."""

TURN_US = 20_000
"""Default time to a companion's next turn in lockstep [µs]."""

LONGEST_REST_US = US_PER_S
"""Maximum time between the companion's turns, so that its messages fit into the socket buffer even
if it does not read [µs]."""

COMPANION_TIMEOUT_S = 60.0
"""Timeout of the companion's turn in lockstep [wall s]."""

FARTHEST_M = 10_000.0
"""Maximum goal distance on each axis."""


class StandAloneVehicle(aircraft.Aircraft):
    """Flight controller, vehicle and camera without a companion, for any client."""

    GROUP: ClassVar[str] = "execution"
    arena: model.ArenaName = model.DEFAULT_ARENA
    computer: Annotated[str, COMMON, "aircraft"] = Field(
        default="workstation",
        description="computer profile that is on board, for its mass and its power: a shipped name,"
        " or a path to a .toml",
    )
    seed: Annotated[int, COMMON] = quantity(
        "seed of arena, sensors, wind and spread", "1", ge=0, le=model.GREATEST_SEED, default=1
    )
    speed: Annotated[float | Literal["max"] | None, COMMON] = optional(
        "simulated seconds per wall second, above 0, at most 100; max: as fast as it"
        " goes, for clients that do not live by the wall clock; by default 1, in lockstep max"
    )
    duration: Annotated[float | None, COMMON] = quantity(
        "end after this simulated time; by default on Ctrl-C", "s", ge=0, le=1e6, default=None
    )
    firmware_log: Path | None = optional(
        "with real firmware that is started here: what it prints goes to this file"
    )
    bind: Annotated[str, "firmware and links"] = Field(
        default=LOOPBACK, description="IPv4 address that links and camera bind"
    )
    companion_host: Annotated[str, "firmware and links"] = Field(
        default=LOOPBACK, description="IPv4 address of the companion computer"
    )
    gcs_host: Annotated[str, "firmware and links"] = Field(
        default=LOOPBACK, description="IPv4 address of the ground station"
    )
    insecure: Annotated[bool, "firmware and links"] = switch(
        "allow addresses that other machines can reach without a signing key: MAVLink"
        " has no other authentication"
    )
    lockstep: Annotated[bool, COMMON] = switch(
        "simulated time waits for one companion that passes turns (airl-companion"
        " --lockstep, or any program that keeps to docs/reference/lockstep-protocol.md): the same"
        " flight every time, bit by bit; there is no ground station then, and the companion's end"
        " ends the flight"
    )
    transport_ms: float = quantity(
        "in lockstep: from a frame's exposure until the companion sees it",
        "ms",
        ge=0,
        le=1000,
        default=checks.TRANSPORT_US / US_PER_MS,
    )
    turn_us: int = quantity(
        "in lockstep: a companion that does not say when it wants its next turn has it this long"
        " after the last, in simulated time",
        "us",
        ge=1,
        le=LONGEST_REST_US,
        default=TURN_US,
    )
    companion_timeout: float = quantity(
        "in lockstep: longest turn of the companion, wall time",
        "s",
        ge=1,
        le=3600,
        default=COMPANION_TIMEOUT_S,
    )
    goal_radius_m: GoalRadius | None = optional(
        "in lockstep: judge the flight, and tell the companion when it is lost; the"
        " goal is reached closer than this: seen from above, if it has no height; by default"
        " nobody judges"
    )
    time_limit_s: TimeLimit = Field(
        default=TIME_LIMIT_S,
        description="with a goal radius: longest flight from the start of navigation",
    )
    parameters_file: Path | None = optional(
        "keep the parameters that clients set in this file: read at the start, written"
        " after every change; QGroundControl loads it, too"
    )
    tlog: Annotated[Path | None, COMMON, "output"] = optional(
        "write the MAVLink log of the onboard link to this file, and the vehicle's log"
        " (.ulg) beside it"
    )

    @property
    def pace(self) -> float | None:
        """Simulated seconds per wall second; None: as fast as possible."""
        if self.speed is None:
            return None if self.lockstep else 1.0
        return self.speed if isinstance(self.speed, float) else None


Start = Literal["arm", "offboard"]
"""Starter of a flight: the companion, or a pilot."""


CameraName = Annotated[
    str,
    Field(
        description="depth camera: the ZeroMQ address of its publisher (tcp://HOST:PORT, ipc://PATH);"
        " realsense, realsense:SERIAL or realsense:FILE.bag; oak-d or oak-d:DEVICE (its id, or its"
        " network address); a topic of ROS 2, ros2:/TOPIC, or a recording, rosbag:PATH; a driver of"
        " your own, FILE.py:NAME or MODULE:NAME"
    ),
]


class NamedCamera(ProfileModel):
    """Camera of a stand-alone program."""

    GROUP: ClassVar[str] = "firmware and links"
    camera: Annotated[CameraName, COMMON] = "tcp://127.0.0.1:5600"
    camera_key: Path | None = optional(
        "decrypt the images of a ZeroMQ address with the key in this file, that of the"
        " publisher (64 hexadecimal digits, mode 0600)"
    )
    insecure: bool = switch("allow unencrypted images of another machine's camera")

    def read_camera_key(self) -> bytes | None:
        """Return the camera's key. Raises FieldError for a bad key, or if the camera needs one."""
        return camera_key(self.camera_key, self.camera, "camera", insecure=self.insecure)


class CompanionAddresses(NamedCamera):
    """Connections of a stand-alone companion to flight controller and camera."""

    connect: Annotated[str, COMMON] = Field(
        default="udpin://127.0.0.1:14540",
        description="MAVSDK connection to the flight controller: udpin://HOST:PORT or"
        " serial://DEVICE:BAUD",
    )


class StandAloneCompanion(CompanionAddresses, model.Lateness, model.Decisions):
    """Stand-alone companion that flies a policy, onboard or against any simulator."""

    GROUP: ClassVar[str] = "execution"
    signing_key: Path | None = optional(
        "sign MAVLink with the key in this file, that of the flight controller (64"
        " hexadecimal digits, mode 0600); over udpin:// only"
    )
    system_id: int | None = quantity(
        "MAVLink system id of the vehicle to fly; by default the only vehicle on the network",
        "1",
        ge=1,
        le=255,
        default=None,
    )
    policy: model.PolicyName = model.DEFAULT_POLICY
    goal: Annotated[Goal, COMMON] = Field(
        default=(20.0, 0.0),
        description="goal, north and east of the start, m, within 10 km; with a third number, down:"
        " -4 is 4 m above the start; without it the goal has no height",
    )
    start: Annotated[Start, COMMON] = Field(
        default="arm",
        description="arm: arms, takes off, flies to the goal and lands; offboard: a pilot"
        " takes off and hands over in flight by switching to Offboard (ArduPilot: GUIDED); the"
        " companion gives the vehicle back in Hold and never arms or lands it",
    )
    vehicle: Annotated[str, COMMON, "aircraft"] = Field(
        default="quad",
        description="vehicle profile: compensation uses its response to setpoints and its camera's"
        " mount",
    )
    check: Annotated[bool, COMMON] = switch(
        "look at camera, flight controller and policy on the ground, say what is wrong,"
        " and end: nothing is armed, no setpoint is sent"
    )
    lockstep: Annotated[bool, COMMON] = switch(
        "take turns with a simulator that waits for this program (airl-firmware"
        " --lockstep): every flight of a seed is the same"
    )
    speed: float = quantity(
        "simulated seconds per wall second of the simulator; 1 on a real aircraft",
        "1",
        ge=0.1,
        le=100,
        default=1.0,
    )
    seed: int = quantity(
        "seed of the injected latency, and of random actions if the policy's card has any",
        "1",
        ge=0,
        le=model.GREATEST_SEED,
        default=1,
    )
    connect_timeout: float = quantity(
        "longest wait for the flight controller; in lockstep for each of its turns, too",
        "s",
        ge=0.1,
        le=3600,
        default=30.0,
    )
    log: Annotated[Path | None, "output"] = optional(
        "write the stamps of every decision to this .npz file"
    )
    black_box: Annotated[Path | None, COMMON, "output"] = optional(
        "record the flight in a new file of this folder, <UTC time>.mcap: decisions,"
        " telemetry, images, status and resources; it survives a crash up to its last second, and"
        " airl report shows it"
    )
    tell_obstacles: bool = switch(
        "send OBSTACLE_DISTANCE from the depth camera, ten times a second, for the"
        " flight controller's collision prevention (CP_DIST), which holds back a pilot in Position"
        " mode"
    )
    black_box_images_hz: Annotated[float, "output"] = quantity(
        "most images that the black box keeps, each one that a decision saw",
        "Hz",
        ge=0,
        le=1000,
        default=10.0,
    )


def check_vehicle(asked: StandAloneVehicle) -> None:
    """Raise FieldError for errors detectable before a port is bound."""
    checks.check_ports(asked.open_ports, any_camera=True)
    speed = asked.speed
    level: model.LevelName = "lockstep" if asked.lockstep else "sitl"
    if asked.signing_key is not None and asked.firmware != "builtin":
        raise FieldError("signing_key", asked.signing_key, "with firmware builtin")
    checks.check_plant(asked)
    checks.check_firmware(asked, "sitl", speed)
    if asked.lockstep and asked.firmware != "builtin":
        raise FieldError(
            "firmware",
            asked.firmware,
            "without lockstep; PX4 is flown in lockstep by airl-sitl and from Python",
        )
    checks.check_faults(asked, level)
    for fault in asked.faults:
        if fault.part in PROCESSES:
            raise FieldError(
                "faults", str(fault), "in a rehearsal (airl-sitl), whose process it is"
            )
    low, high = LOCKSTEP_SPEEDS if asked.lockstep else SPEEDS
    if isinstance(speed, float) and not (low < speed <= high or low == speed > 0.0):
        sign = "<=" if asked.lockstep else "<"
        raise FieldError("speed", speed, f"{low:g} {sign} value <= {high:g}, or max")
    hosts = {asked.bind, asked.companion_host, asked.gcs_host}
    if asked.firmware in ("px4", "ardupilot") and hosts != {LOOPBACK}:
        raise FieldError(
            "firmware",
            asked.firmware,
            "without bind, companion_host and gcs_host; its links are its own, on this machine",
        )
    _check_folder("tlog", asked.tlog)
    if asked.parameters_file is not None:
        if asked.lockstep:
            raise FieldError("parameters_file", asked.parameters_file, "without lockstep")
        if asked.firmware != "builtin":
            problem = "real firmware keeps its own parameters"
            raise FieldError("parameters_file", asked.parameters_file, problem=problem)
        _check_folder("parameters_file", asked.parameters_file)


def check_companion(asked: StandAloneCompanion) -> None:
    """Raise FieldError for errors detectable before a connection is opened."""
    asked.read_camera_key()
    for metres in asked.goal:
        if not abs(metres) <= FARTHEST_M:
            raise FieldError("goal", metres, f"{-FARTHEST_M:g} <= value <= {FARTHEST_M:g} m")
    if asked.black_box is not None and find_spec("mcap") is None:
        accepted = "with MCAP installed: pip install 'airl-mav[black-box]'"
        raise FieldError("black_box", f"{asked.black_box}", accepted)
    if asked.lockstep:
        address = "in lockstep the address of the simulator's camera: tcp://HOST:PORT, ipc://PATH"
        for field, bad, accepted in (
            ("camera", "://" not in asked.camera, address),
            ("black_box", asked.black_box is not None, "without lockstep, which paces nothing"),
            ("tell_obstacles", asked.tell_obstacles, "without lockstep"),
            ("check", asked.check, "without lockstep"),
            ("start", asked.start != "arm", "arm in lockstep, where nobody else flies"),
        ):
            if bad:
                value = getattr(asked, field)
                raise FieldError(field, f"{value}" if isinstance(value, Path) else value, accepted)
    _check_folder("log", asked.log)


def _check_folder(field: str, file: Path | None) -> None:
    """Raise FieldError for a file in a missing folder."""
    if file is not None and not file.parent.is_dir():
        raise FieldError(field, file, problem=f"no folder {file.parent}")
