"""The battery: a coulomb counter behind an open-circuit voltage and an internal resistance."""

from __future__ import annotations

import math

from airl_mav.core.constants import C_PER_MAH
from airl_mav.core.kernels import kernel


@kernel
def terminal_voltage(open_circuit_v: float, resistance_ohm: float, power: float) -> float:
    """Return the voltage under a constant-power load [W]: V = E - R P / V, upper root.

    Above the greatest power that the pack can deliver, E²/4R, the voltage at that power: E/2.
    """
    discriminant = open_circuit_v * open_circuit_v - 4.0 * resistance_ohm * power
    return 0.5 * (open_circuit_v + math.sqrt(max(0.0, discriminant)))


@kernel
def open_circuit(remaining: float, empty_v: float, full_v: float) -> float:
    """Return the open-circuit voltage, linear in the state of charge 0..1."""
    return empty_v + (full_v - empty_v) * remaining


@kernel
def drain(remaining: float, current_a: float, capacity_mah: float, dt: float) -> float:
    """Return the state of charge after dt [s] at a current [A], not below 0."""
    return max(0.0, remaining - current_a * (dt / (capacity_mah * C_PER_MAH)))
