"""Motor reports of the speed controllers.

Source: PX4 1.16, SimulatorMavlink::send_esc_telemetry. Like PX4, the simulation does not model
them. A stopped motor draws no current.
"""

from __future__ import annotations

RPM = 6_000
"""Speed at full command [rpm]."""
IDLE_A, SPAN_A = 1.0, 15.0
IDLE_C, SPAN_C = 20.0, 40.0
"""Current [A] and temperature [°C] of a motor at minimum speed, and their rise at full command."""


def current_a(output: float) -> float:
    """Return the current [A] of a healthy motor at this command 0..1."""
    return IDLE_A + SPAN_A * output if output > 0.0 else 0.0
