"""Flight settings and latency of a policy: as configured, else from its card, else defaults.

The companion's part of a scenario's resolution; imports no simulator.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import numpy as np

from airl_mav.core.constants import US_PER_MS
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import Goal
from airl_mav.core.scheduling import check_permitted
from airl_mav.latency.injection import Injection, select_injection
from airl_mav.policy.actions import Policy
from airl_mav.policy.registry import PolicyInfo, load_policy
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.model import Decisions, Lateness, LevelName, PilotSettings, WatchdogSettings

ACTION_STREAM = 1
"""Second word of the seed of a policy's random actions, distinct from latency draws."""

NATIVE_T2_US = round(1.0 * US_PER_MS)
"""Default t2 without injection or native timing: a desktop computer's [µs]."""

TRANSPORT_US = round(5.0 * US_PER_MS)
"""Default time from exposure to decoding without native timing: t1 minus the frame wait [µs]."""


def decide_piloting(
    asked: Decisions, policy: PolicyInfo, goal_radius_m: float
) -> tuple[PilotSettings, WatchdogSettings]:
    """Return the flight settings of a policy: as configured, else from its card, else defaults.

    `goal_radius_m` applies to a policy without a card. Raises FieldError if a decision would be
    overdue before the previous hold time is over.
    """
    card = policy.card
    known: dict[str, Any] = {"goal_radius_m": goal_radius_m}
    if policy.commands != "velocity":
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
    names = asdict(PilotSettings()).keys() - {"commands"}
    given = {name: value for name in names if (value := getattr(asked, name)) is not None}
    pilot = PilotSettings(commands=policy.commands, **(known | given))
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
    policy: PolicyInfo, asked: str, *, level: str, firmware: str = "builtin"
) -> None:
    """Raise FieldError for commands that the level or the firmware does not support."""
    if policy.commands == "velocity":
        return
    words = policy.commands.replace("_", " ")
    if level == "gym" and policy.commands == "attitude":
        accepted = "at level lockstep or sitl: the batch twin flies velocities and body rates"
    elif firmware == "ardupilot":
        accepted = "with firmware builtin or PX4: ArduPilot takes a thrust for a climb rate"
    else:
        return
    raise FieldError("policy", asked, f"one that commands {words}, {accepted}")


def check_compensated(pilot: PilotSettings, policy: PolicyInfo, vehicle: VehicleProfile) -> None:
    """Raise FieldError for unsupported latency compensation.

    Compensation does not support policies without velocity commands, whose effect is not predicted,
    nor policies with additional cameras, whose images are not predicted.
    """
    if pilot.compensate and policy.commands != "velocity":
        raise FieldError(
            "compensate",
            True,
            problem=f"policy {policy.name} commands {policy.commands.replace('_', ' ')}, whose"
            " effect is not foreseen; accepted: no compensation",
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


def check_goal_height(policy: PolicyInfo, goal: Goal, field: str, asked: object) -> None:
    """Raise FieldError, of `field`, if the policy requires a goal height and the goal has none."""
    if policy.card is not None and policy.card.observation.goal_height and len(goal) == 2:
        raise FieldError(
            field,
            asked,
            f"a goal with a height, which policy {policy.name} is told (its card's goal_height)",
        )


def check_quota(asked: Decisions, injection: Injection, level: LevelName) -> None:
    """Raise UsageError for a processor limit without effect, or without permission."""
    if asked.cpu_quota is None:
        return
    if level != "sitl" or injection.latency is not None:
        why = "an injected latency" if level == "sitl" else f"level {level}"
        raise FieldError(
            "cpu_quota",
            asked.cpu_quota,
            f"without {why}: only where the companion's own time counts",
        )
    check_permitted(asked.cpu_quota)


def select_latency(asked: Lateness, policy: PolicyInfo, *, on_this_computer: bool) -> Injection:
    """Return the latency of a stand-alone companion.

    `on_this_computer`: the companion runs on the selected computer itself, so that measured
    latencies are not added. Raises UsageError for an unknown computer, workload or source.
    """
    return select_injection(
        asked.latency,
        load_computer(asked.computer),
        asked.workload,
        policy_sha256=None if on_this_computer else policy.sha256,
        macs=policy.macs,
    )


def load_asked_policy(asked: Decisions, policy: PolicyInfo, hold_s: float, seed: int) -> Policy:
    """Return the configured policy, ready to decide. Raises UsageError."""
    return load_policy(
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


def between_commands(pilot: PilotSettings, hover_s: float | None) -> str:
    """Return the behaviour between commands as text."""
    words = ["persist" if hover_s is None else f"hover-after {1e3 * hover_s:g} ms"]
    if pilot.decisions != PilotSettings.decisions:
        words.append(f"{pilot.decisions} decisions")
    if pilot.compensate:
        words.append("latency compensated")
    if pilot.commands != "velocity":
        words.append(f"{pilot.commands.replace('_', ' ')} and thrust")
    return ", ".join(words)
