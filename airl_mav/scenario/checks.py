"""Checks for fields that contradict each other, or the vehicle, before a port is bound."""

from __future__ import annotations

from collections.abc import Sequence

from airl_mav.core.errors import FieldError
from airl_mav.faults.fault import TWIN, Fault, check_twin
from airl_mav.faults.kinds import LINKS
from airl_mav.profiles.projections import SLOW, Renderer
from airl_mav.profiles.vehicle import Sensors
from airl_mav.scenario.aircraft import GREATEST_PORT, HAS_PYBULLET, NO_TWIN, Aircraft, Ports
from airl_mav.scenario.model import LevelName, Scenario

SITL_SPEEDS = 0.5, 10.0
"""Speed range supported by MAVSDK's wall-clock timeouts: slower, it misses heartbeats (1 Hz of
simulated time, 3 s allowed); faster, its 20 Hz of setpoints approach offboard loss."""

NOT_IN_THE_AIR = ("ground", "climb", "landing")
"""Flight phases, by fault names, that a hover start skips."""

REAL_FIRMWARE_NEEDS = {
    "px4": ("px4_dir", "px4_connect"),
    "ardupilot": ("ardupilot_dir", "ardupilot_connect"),
    "px4-hitl": ("serial",),
}
"""Each kind of real firmware requires exactly one of its fields."""


def check_level(scenario: Scenario) -> None:
    """Raise FieldError for a field that the level does not support."""
    level = scenario.level
    if level == "sitl":
        if scenario.ablate is not None:
            raise FieldError("ablate", scenario.ablate, "at level gym or lockstep")
        low, high = SITL_SPEEDS
        if scenario.speed is not None and not low <= scenario.speed <= high:
            raise FieldError("speed", scenario.speed, f"{low:g} <= value <= {high:g} at level sitl")
    elif level == "gym":
        usual = Scenario()
        for field, declared in Scenario.model_fields.items():
            if NO_TWIN not in declared.metadata:
                continue
            if (value := getattr(scenario, field)) != getattr(usual, field):
                raise FieldError(field, value, NO_TWIN)
    check_faults(scenario, level)
    check_drawing(scenario.renderer, level)
    if level != "lockstep" and scenario.tlogs:
        raise FieldError("tlogs", scenario.tlogs, "at level lockstep")
    if level == "sitl" and scenario.workers is not None:
        raise FieldError("workers", scenario.workers, "at level gym or lockstep")


def check_start(scenario: Scenario) -> None:
    """Raise FieldError for a hover start incompatible with the firmware or a fault."""
    if scenario.start == "ground":
        return
    if scenario.firmware != "builtin":
        raise FieldError("start", scenario.start, "ground with real firmware")
    for fault in scenario.faults:
        if fault.phase in NOT_IN_THE_AIR:
            raise FieldError(
                "faults", str(fault), f"start ground, as a hover start has no {fault.phase}"
            )


def check_drawing(renderer: Renderer, level: LevelName) -> None:
    """Raise FieldError for a renderer that the level does not support."""
    if renderer in SLOW and level == TWIN:
        raise FieldError("renderer", renderer, "raycast, but at level lockstep or sitl")


def check_faults(asked: Aircraft, level: LevelName) -> None:
    """Raise FieldError for a fault that the level or the firmware does not support."""
    if level == TWIN:
        check_twin(asked.faults)
    for fault in asked.faults:
        part, levels = fault.part, fault.about.levels
        if level not in levels:
            raise FieldError("faults", str(fault), f"at level {' or '.join(levels)}")
        if part == "firmware" and asked.firmware != "builtin":
            raise FieldError("faults", str(fault), "with firmware builtin")
        if part in LINKS and asked.firmware != "builtin":
            raise FieldError(
                "faults", str(fault), "with firmware builtin: real firmware has links of its own"
            )


def check_fitted(sensors: Sensors, faults: Sequence[Fault]) -> None:
    """Raise FieldError for a fault of a sensor that the vehicle lacks."""
    fitted = {"gps": sensors.gps.fitted, "vision": sensors.vision is not None}
    fitted["rangefinder"] = sensors.rangefinder is not None
    fitted["flow"] = sensors.optical_flow is not None
    for fault in faults:
        if not fitted.get(fault.part, True):
            raise FieldError("faults", str(fault), f"with a vehicle that has {fault.part}")


def check_plant(asked: Aircraft) -> None:
    """Raise FieldError for a plant that is not installed."""
    if asked.plant == "pybullet" and not HAS_PYBULLET:
        accepted = "kernel: pybullet is not installed (it has wheels for CPython 3.10 and 3.11 on"
        accepted += " Linux x86-64)"
        raise FieldError("plant", asked.plant, accepted)


def check_ports(ports: Ports, *, any_camera: bool) -> None:
    """Raise FieldError for an invalid or duplicate port; `any_camera` allows camera port 0."""
    for field in ("api_port", "gcs_port", *(() if any_camera else ("camera_port",))):
        if getattr(ports, field) == 0:
            raise FieldError(f"ports.{field}", 0, "1 <= value <= 65535")
    for field, port in ports:
        if port > GREATEST_PORT:
            raise FieldError(f"ports.{field}", port, f"value + instance <= {GREATEST_PORT}")
    if ports.api_port == ports.gcs_port:
        raise FieldError("ports.gcs_port", ports.gcs_port, "another than that of the onboard API")


def check_firmware(asked: Aircraft, level: LevelName, speed: float | str | None) -> None:
    """Raise FieldError for options that real firmware does not support; None: default speed."""
    firmware, real = asked.firmware, asked.real
    if asked.signing_key is not None and (level != "sitl" or firmware != "builtin"):
        accepted = "at level sitl, with firmware builtin"
        raise FieldError("signing_key", asked.signing_key, accepted)
    given = {name for name, value in real if value not in (None, False)}
    for kind, names in REAL_FIRMWARE_NEEDS.items():
        mine = [name for name in names if name in given]
        if kind != firmware and mine:
            raise FieldError(f"real.{mine[0]}", getattr(real, mine[0]), f"with firmware {kind}")
        if kind == firmware and len(mine) != 1:
            raise FieldError("firmware", firmware, f"with {' or '.join(names)}")
    if firmware == "builtin":
        return
    if level == "gym":
        raise FieldError("firmware", firmware, "at level lockstep or sitl: the twin has its own")
    if level == "lockstep" and firmware != "px4":
        raise FieldError(
            "firmware",
            firmware,
            "at level sitl; at level lockstep only builtin and px4 share the companion's clock",
        )
    if firmware == "px4-hitl" and speed not in (None, 1.0):
        raise FieldError("speed", speed, "1 with firmware px4-hitl, a board's own pace")
    if firmware == "px4":
        usual = Ports()
        for name, value in asked.ports:
            if name != "camera_port" and value != getattr(usual, name):
                raise FieldError(
                    f"ports.{name}", value, "its default: PX4 SITL's ports move with instance"
                )
