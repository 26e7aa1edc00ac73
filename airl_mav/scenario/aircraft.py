"""Aircraft of a scenario: vehicle, payload, wind, firmware and connections."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from airl_mav.core.fields import COMMON, ProfileModel, optional, quantity, switch
from airl_mav.faults import Fault
from airl_mav.profiles.px4_release import CURRENT, PX4ReleaseName
from airl_mav.profiles.vehicle import Payload, SensorNoise, Spread, WindSettings

VehicleName = Annotated[
    str, Field(description="vehicle profile: a shipped name, or a path to a .toml"), COMMON
]

DEFAULT_VEHICLE = "quad"
"""Default vehicle profile."""

GREATEST_PORT = 65_535

GREATEST_INSTANCE = 9
"""Maximum instance: PX4's higher instances share one API port, 14549 (px4-rc.mavlink)."""

EstimatorName = Literal["kernel", "filterpy"]
PlantName = Literal["pybullet", "kernel"]
FirmwareName = Literal["builtin", "px4", "ardupilot", "px4-hitl", "attach"]


def _is_installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ImportError:
        # Restrictive import hooks may raise here.
        return False


HAS_PYBULLET = _is_installed("pybullet")
"""True if pybullet is installed."""

DEFAULT_PLANT: PlantName = "pybullet" if HAS_PYBULLET else "kernel"

FREE = "decides no flight"
"""Marks a field that may differ when a run is resumed."""

IN_WORDS = "each in words on a command line"
"""Marks a list of texts, each a separate command-line option."""

NOT_IN_GYM = "at level lockstep or sitl; the vectorized simulator has none"
"""Marks a field that must keep its default at level gym."""


def _port(description: str, default: int) -> Any:
    return quantity(description, "1", ge=0, le=GREATEST_PORT, default=default)


class Ports(ProfileModel):
    """UDP ports of the MAVLink links, as in PX4 SITL, and the camera's TCP port."""

    GROUP: ClassVar[str] = "firmware and links"
    api_port: int = _port("UDP port of the onboard API, where MAVSDK listens", 14540)
    api_local_port: int = _port(
        "UDP port that the flight controller's onboard link binds; 0: any free one", 14580
    )
    gcs_port: int = _port("UDP port of the ground station, where QGroundControl listens", 14550)
    gcs_local_port: int = _port(
        "UDP port that the flight controller's ground station link binds; 0: any free one", 18570
    )
    camera_port: int = _port(
        "TCP port (ZeroMQ) of the depth camera; 0: any free one, where the client is told of it",
        5600,
    )


class RealFirmware(ProfileModel):
    """Real firmware: start settings, or the connection to a firmware started by the user."""

    GROUP: ClassVar[str] = "firmware and links"
    px4_dir: Path | None = optional(
        "with firmware px4: start this PX4 for every flight; a SITL build, its source"
        " tree, or an unpacked package"
    )
    px4_connect: bool = switch("with firmware px4: wait for a PX4 that you start for every flight")
    ardupilot_dir: Path | None = optional(
        "with firmware ardupilot: start this ArduCopter for every flight; a SITL build,"
        " its source tree, or the program itself"
    )
    ardupilot_connect: bool = switch(
        "with firmware ardupilot: wait for an ArduCopter that you start for every flight"
    )
    instance: int = quantity(
        "instance number: moves all ports of the flight controller and that of the camera, as PX4's"
        " -i and ArduPilot's -I do; the built-in one is system N + 1 then, as PX4 is; with PX4 at"
        " level lockstep the first that is tried: flights side by side take the next free ones",
        "1",
        ge=0,
        le=GREATEST_INSTANCE,
        default=0,
    )
    connect: str | None = optional(
        "with firmware attach: second MAVLink link of a vehicle that flies elsewhere, beside the"
        " companion's: udpin://127.0.0.1:14550"
    )
    serial: str | None = optional(
        "with firmware px4-hitl: serial device of the board: /dev/ttyACM0"
    )
    baud: int = quantity(
        "with serial: bits a second; USB takes no notice of it",
        "1/s",
        ge=9_600,
        le=12_000_000,
        default=921_600,
    )
    firmware_timeout: float = quantity(
        "longest wait for real firmware to connect, and for each answer before take-off, wall time",
        "s",
        ge=1,
        le=3600,
        default=60.0,
    )
    firmware_dir: Path | None = optional(
        "keep what real firmware leaves (parameters, flight logs) in this folder, one"
        " folder a flight; by default it is removed"
    )


class Aircraft(ProfileModel):
    """Aircraft and its connections."""

    GROUP: ClassVar[str] = "aircraft"
    vehicle: VehicleName = DEFAULT_VEHICLE
    payload: Payload = Field(default_factory=Payload, description="payload")
    battery_charge: float = quantity(
        "state of charge of the battery at the start", "1", gt=0, le=1, default=1.0
    )
    wind: WindSettings = Field(default_factory=WindSettings, description="wind")
    spread: Spread = Field(default_factory=Spread, description="spread of the aircraft")
    sensors: SensorNoise = Field(default_factory=SensorNoise, description="sensors' noise")
    faults: Annotated[tuple[Fault, ...], IN_WORDS] = Field(
        default=(),
        description="faults that happen in every flight, in words: gps off at 8s for 5s; see"
        " docs/how-to/faults.md",
    )
    estimator: Annotated[EstimatorName, NOT_IN_GYM, "sensors"] = Field(
        default="kernel",
        description="filter of the state estimator: the compiled one, or filterpy's, its reference,"
        " some twenty times slower",
    )
    plant: PlantName = Field(
        default=DEFAULT_PLANT,
        description="physics engine: pybullet, or the vectorized simulator's compiled rigid body"
        " (default without pybullet); not at level gym",
    )
    firmware: Annotated[FirmwareName, COMMON, "firmware and links"] = Field(
        default="builtin",
        description="flight controller: the built-in one, or real firmware on this vehicle and its"
        " sensors; see docs/how-to/real-firmware.md",
    )
    px4_release: Annotated[PX4ReleaseName | None, "firmware and links"] = optional(
        "PX4 release that the built-in flight controller emulates: parameters, gains and failsafes;"
        f" by default as the vehicle's profile says, or {CURRENT}"
    )
    real: RealFirmware = Field(default_factory=RealFirmware, description="real firmware")
    signing_key: Annotated[Path | None, FREE, "firmware and links"] = optional(
        "sign MAVLink with the key in this file (64 hexadecimal digits, mode 0600), and"
        " refuse what is not signed with it"
    )
    camera_key: Annotated[Path | None, FREE, "firmware and links"] = optional(
        "encrypt the camera's images with the key in this file (64 hexadecimal digits,"
        " mode 0600), and send them to programs with this key only"
    )
    ports: Annotated[Ports, FREE] = Field(default_factory=Ports, description="ports")

    @property
    def open_ports(self) -> Ports:
        """Ports of this instance.

        As with PX4's `-i`, the instance number shifts all ports except the ground station's. Real
        firmware shifts its own ports.
        """
        moved = ["camera_port"]
        if self.firmware == "builtin":
            moved += ["api_port", "api_local_port", "gcs_local_port"]
        asked = self.ports.model_dump()
        # 0 stays 0: any free port.
        by_name = {name: asked[name] and asked[name] + self.real.instance for name in moved}
        return self.ports.model_copy(update=by_name)

    @property
    def system_id(self) -> int | None:
        """MAVLink system id of the built-in flight controller; None = that of real firmware."""
        return self.real.instance + 1 if self.firmware == "builtin" else None

    @property
    def companion_port(self) -> int:
        """UDP port on which a companion listens for the flight controller."""
        moved = self.real.instance if self.firmware == "px4" else 0
        return self.open_ports.api_port + moved
