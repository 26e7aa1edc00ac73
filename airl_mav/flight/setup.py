"""What was flown on what: the facts that head every report."""

from __future__ import annotations

from dataclasses import dataclass

from airl_mav.core.constants import Level
from airl_mav.latency.injection import Injection

BUILT_IN = "built-in"
"""The firmware of all levels but one."""


@dataclass(frozen=True)
class Part:
    """One part of a rehearsal: the vehicle, the arena, the policy, the computer."""

    name: str
    description: str = ""


@dataclass(frozen=True)
class Setup:
    """The parts of a rehearsal, in words."""

    level: Level
    """Rung of the fidelity ladder."""
    vehicle: Part
    arena: Part
    policy: Part
    computer: Part
    computer_watts: float
    """What the computer draws from the aircraft's pack [W]; 0 of one that stays on the ground."""
    injection: Injection
    """The decision latency t2: measured, injected or estimated."""
    speed: float | None
    """Simulated seconds per wall second; None where time is not paced (lockstep)."""
    between_commands: str
    """What the vehicle does between commands: `persist`, `hover-after 60 ms`."""
    firmware: str = BUILT_IN
    """What flew: the built-in autopilot, or the name of real firmware."""
    computer_on_ground: bool = False
    """The computer is ground equipment: the aircraft carries and feeds none."""
    conditions: str = ""
    """Wind, load, spread, noise, charge and renderer, where not the defaults: `wind.east_m_s 4`."""
