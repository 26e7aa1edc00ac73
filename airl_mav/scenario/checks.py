"""Checks of a scenario's fields before a port is bound, and the flight settings of its policy.

Settings are as configured, else from the policy's card, else defaults. The companion uses this
module, too: it imports no simulator.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from airl_mav.core.constants import US_PER_MS
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import Goal
from airl_mav.faults import GYM, LINKS, Fault, check_gym
from airl_mav.latency.injection import Injection, select_injection
from airl_mav.policy import actions, registry
from airl_mav.profiles import computer
from airl_mav.profiles.vehicle import Sensors, VehicleProfile
from airl_mav.scenario import model
from airl_mav.scenario.aircraft import GREATEST_PORT, HAS_PYBULLET, NOT_IN_GYM, Aircraft, Ports

SITL_SPEEDS = 0.5, 10.0
"""Speed range supported by MAVSDK's wall-clock timeouts: slower, it misses heartbeats (1 Hz of
simulated time, 3 s allowed); faster, its 20 Hz of setpoints approach offboard loss."""

NOT_IN_THE_AIR = ("ground", "climb", "landing")
"""Flight phases, by fault names, that a hover start skips."""

REAL_FIRMWARE_NEEDS = {
    "px4": ("px4_dir", "px4_connect"),
    "ardupilot": ("ardupilot_dir", "ardupilot_connect"),
    "px4-hitl": ("serial",),
    "attach": ("connect",),
}
"""Each kind of real firmware requires exactly one of its fields."""


def check_level(scenario: model.Scenario) -> None:
    """Raise FieldError for a field that the level does not support."""
    level = scenario.level
    if level == "sitl":
        if scenario.ablate is not None:
            raise FieldError("ablate", scenario.ablate, "at level gym or lockstep")
        low, high = SITL_SPEEDS
        if scenario.speed is not None and not low <= scenario.speed <= high:
            raise FieldError("speed", scenario.speed, f"{low:g} <= value <= {high:g} at level sitl")
    elif level == "gym":
        usual = model.Scenario()
        for field, declared in model.Scenario.model_fields.items():
            if NOT_IN_GYM not in declared.metadata:
                continue
            if (value := getattr(scenario, field)) != getattr(usual, field):
                raise FieldError(field, value, NOT_IN_GYM)
    check_faults(scenario, level)
    if level != "lockstep" and scenario.tlogs:
        raise FieldError("tlogs", scenario.tlogs, "at level lockstep")
    if level == "sitl" and scenario.workers is not None:
        raise FieldError("workers", scenario.workers, "at level gym or lockstep")


def check_start(scenario: model.Scenario) -> None:
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


def check_faults(asked: Aircraft, level: model.LevelName) -> None:
    """Raise FieldError for a fault that the level or the firmware does not support."""
    if level == GYM:
        check_gym(asked.faults)
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


def check_firmware(asked: Aircraft, level: model.LevelName, speed: float | str | None) -> None:
    """Raise FieldError for options that real firmware does not support; None: default speed."""
    firmware, real = asked.firmware, asked.real
    if asked.signing_key is not None and (level != "sitl" or firmware != "builtin"):
        accepted = "at level sitl, with firmware builtin"
        raise FieldError("signing_key", asked.signing_key, accepted)
    if asked.camera_key is not None and level != "sitl":
        raise FieldError("camera_key", asked.camera_key, "at level sitl, whose camera has a socket")
    given = {name for name, value in real if value not in (None, False)}
    for kind, names in REAL_FIRMWARE_NEEDS.items():
        mine = [name for name in names if name in given]
        if kind != firmware and mine:
            raise FieldError(f"real.{mine[0]}", getattr(real, mine[0]), f"with firmware {kind}")
        if kind == firmware and len(mine) != 1:
            raise FieldError("firmware", firmware, f"with {' or '.join(names)}")
    if firmware == "builtin":
        return
    if asked.px4_release is not None:
        raise FieldError("px4_release", asked.px4_release, "with firmware builtin")
    if level == "gym":
        raise FieldError(
            "firmware", firmware, "at level lockstep or sitl: the vectorized simulator has its own"
        )
    if level == "lockstep" and firmware != "px4":
        raise FieldError(
            "firmware",
            firmware,
            "at level sitl; at level lockstep only builtin and px4 share the companion's clock",
        )
    if firmware in ("px4-hitl", "attach") and speed not in (None, 1.0):
        raise FieldError("speed", speed, f"1 with firmware {firmware}, which has a pace of its own")
    if firmware == "attach":
        check_attached(asked)
    if firmware == "px4":
        usual = Ports()
        for name, value in asked.ports:
            if name != "camera_port" and value != getattr(usual, name):
                raise FieldError(
                    f"ports.{name}", value, "its default: PX4 SITL's ports move with instance"
                )


NEED_PLANT = {"payload", "battery_charge", "wind", "spread", "faults"}
"""Fields that change a vehicle simulated here."""


def check_attached(asked: Aircraft) -> None:
    """Raise FieldError for a field that a vehicle elsewhere does not support."""
    for field, value in asked.model_dump(include=NEED_PLANT, exclude_defaults=True).items():
        name, told = field, str(value)
        if isinstance(value, dict):
            name, told = next((f"{field}.{each}", f"{inner}") for each, inner in value.items())
        accepted = "its default with firmware attach, whose vehicle flies elsewhere"
        raise FieldError(name, told, accepted)


ACTION_STREAM = 1
"""Second word of the seed of a policy's random actions, distinct from latency draws."""

NATIVE_T2_US = round(1.0 * US_PER_MS)
"""Default t2 without injection or native timing: a desktop computer's [µs]."""

TRANSPORT_US = round(5.0 * US_PER_MS)
"""Default time from exposure to decoding without native timing: t1 minus the frame wait [µs]."""


def decide_piloting(
    asked: model.Decisions, policy: registry.PolicyInfo, goal_radius_m: float
) -> tuple[model.PilotSettings, model.WatchdogSettings]:
    """Return the flight settings of a policy: as configured, else from its card, else defaults.

    `goal_radius_m` applies to a policy without a card. Raises FieldError if a decision would be
    overdue before the previous hold time is over.
    """
    card = policy.card
    known: dict[str, Any] = {"goal_radius_m": goal_radius_m}
    built_in = None if policy.program else registry.POLICIES.get(policy.name)
    if built_in is not None and built_in.hold_s is not None:
        known["hold_s"] = built_in.hold_s
    if not actions.KINDS[policy.commands].steady:
        # Decide on every image: nothing else keeps the vehicle level.
        known["decisions"] = "pipelined"
    hover_s = asked.watchdog.hover_after_s
    if card is not None:
        known = {
            "hold_s": card.hold_s,
            "goal_radius_m": card.goal_radius_m,
            "altitude_m": card.altitude_m,
            "max_speed_m_s": card.actions.max_speed_m_s,
            "decisions": card.decisions,
            "compensate": card.compensate,
        }
        hover_s = card.hover_after_s if hover_s is None else hover_s
    names = asdict(model.PilotSettings()).keys() - {"commands"}
    given = {name: value for name in names if (value := getattr(asked, name)) is not None}
    pilot = model.PilotSettings(commands=policy.commands, **(known | given))
    if pilot.decisions == "pipelined" and hover_s is not None:
        raise FieldError(
            "decisions", pilot.decisions, "without watchdog.hover_after_s, as no hold ends"
        )
    held_s = pilot.hold_s if pilot.decisions == "sequential" else 0.0
    on_card = None if card is None else card.decision_timeout_s
    timeout_s = asked.watchdog.timeout_s(pilot.commands, held_s, on_card)
    if timeout_s <= held_s:
        raise FieldError(
            "watchdog.decision_timeout_s",
            timeout_s,
            f"more than the hold time, {pilot.hold_s:g} s, or every decision is overdue",
        )
    bounds = {"hover_after_s": hover_s, "decision_timeout_s": timeout_s}
    return pilot, asked.watchdog.model_copy(update=bounds)


def check_commands(
    policy: registry.PolicyInfo, asked: str, *, level: str, firmware: str = "builtin"
) -> None:
    """Raise FieldError for commands that the level or the firmware does not support."""
    kind = actions.KINDS[policy.commands]
    if level not in kind.levels:
        accepted = (
            "at level lockstep or sitl: the vectorized simulator flies velocities and body rates"
        )
    elif firmware == "ardupilot" and not kind.steady:
        accepted = "with firmware builtin or PX4: ArduPilot takes a thrust for a climb rate"
    else:
        return
    raise FieldError("policy", asked, f"one that commands {kind.title}, {accepted}")


def check_compensated(
    pilot: model.PilotSettings, policy: registry.PolicyInfo, vehicle: VehicleProfile
) -> None:
    """Raise FieldError for unsupported latency compensation.

    Compensation does not support policies without velocity commands, whose effect is not predicted,
    nor policies with additional cameras, whose images are not predicted.
    """
    kind = actions.KINDS[policy.commands]
    if pilot.compensate and not kind.steady:
        raise FieldError(
            "compensate",
            True,
            problem=f"policy {policy.name} commands {kind.title}, whose effect is not foreseen;"
            " accepted: no compensation",
        )
    seen: Iterable[str] = ()
    if policy.card is not None:
        seen = policy.card.observation.cameras
    elif policy.program is not None:
        seen = vehicle.cameras
    if pilot.compensate and (names := ", ".join(seen)):
        raise FieldError(
            "compensate",
            True,
            problem=f"policy {policy.name} sees by further cameras ({names}), whose images are not"
            " carried forward; accepted: no compensation",
        )


def check_goal_height(policy: registry.PolicyInfo, goal: Goal, field: str, asked: object) -> None:
    """Raise FieldError, of `field`, if the policy requires a goal height and the goal has none."""
    if policy.card is not None and policy.card.observation.goal_height and len(goal) == 2:
        raise FieldError(
            field,
            asked,
            f"a goal with a height, which policy {policy.name} is told (its card's goal_height)",
        )


def select_latency(
    asked: model.Lateness, policy: registry.PolicyInfo, *, on_this_computer: bool
) -> Injection:
    """Return the latency of a stand-alone companion.

    `on_this_computer`: the companion runs on the selected computer itself, so that measured
    latencies are not added. Raises UsageError for an unknown computer, workload or source.
    """
    return select_injection(
        asked.latency,
        computer.load_computer(asked.computer),
        asked.workload,
        policy_sha256=None if on_this_computer else policy.sha256,
        macs=policy.macs,
    )


def load_asked_policy(
    asked: model.Decisions, policy: registry.PolicyInfo, hold_s: float, seed: int
) -> actions.Policy:
    """Return the configured policy, ready to decide. Raises UsageError."""
    return registry.load_policy(
        policy,
        hold_s,
        runtime=asked.runtime,
        threads=asked.threads,
        rng=action_generator(seed),
        ablate=asked.ablate,
        trust=asked.trust,
    )


def action_generator(seed: int) -> np.random.Generator:
    """Return the generator of a policy's random actions in the flight of a seed."""
    return np.random.default_rng((seed, ACTION_STREAM))


def between_commands(pilot: model.PilotSettings, hover_s: float | None) -> str:
    """Return the behaviour between commands as text."""
    words = ["persist" if hover_s is None else f"hover-after {1e3 * hover_s:g} ms"]
    if pilot.decisions != model.PilotSettings.decisions:
        words.append(f"{pilot.decisions} decisions")
    if pilot.compensate:
        words.append("latency compensated")
    if not actions.KINDS[pilot.commands].steady:
        words.append(f"{actions.KINDS[pilot.commands].title} and thrust")
    return ", ".join(words)
