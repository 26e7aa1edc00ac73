"""Reports of the speed controllers about their motors.

Source: PX4 1.16, SimulatorMavlink::send_esc_telemetry: it has no model of them, and neither has
this. A motor that does not turn draws nothing.
"""

from __future__ import annotations

RPM = 6_000
"""Speed at full command [rpm]."""
IDLE_A, SPAN_A = 1.0, 15.0
IDLE_C, SPAN_C = 20.0, 40.0
"""Current [A] and temperature [°C] of a motor that just turns, and what full command adds."""


def current_a(output: float) -> float:
    """Return the current [A] of a motor that turns as a healthy one at this command 0..1."""
    return IDLE_A + SPAN_A * output if output > 0.0 else 0.0
