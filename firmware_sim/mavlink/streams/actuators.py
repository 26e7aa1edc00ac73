"""Motor commands and pulse widths."""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import Arming, AutopilotState
from firmware_sim.mavlink.codec import Values
from firmware_sim.mavlink.px4_custom_mode import base_mode
from firmware_sim.mavlink.streams import units

_PWM_DISARMED, _PWM_MIN, _PWM_SPAN = 900, 1_000, 1_000
"""Pulse widths [µs] of PX4's simulated outputs (src/modules/simulation/pwm_out_sim)."""

_OUTPUTS = 16
"""Of PX4's simulation. Those that drive no motor stay at the disarmed pulse."""

_OUTPUT_FIELDS = 32
"""Slots of ACTUATOR_OUTPUT_STATUS."""


def actuator_output_status(state: AutopilotState) -> Values:
    """The same pulse widths as an array of 16 outputs in use."""
    return state.time_us, _OUTPUTS, *_outputs(state), *(0,) * (_OUTPUT_FIELDS - _OUTPUTS)


def hil_actuator_controls(state: AutopilotState) -> Values:
    """Motor commands 0..1, zero while disarmed; 16 controls."""
    commands, flags = _commands(state), 0
    unused = (0.0,) * (_OUTPUTS - len(commands))
    return state.time_us, *commands, *unused, base_mode(state.status), flags


def _outputs(state: AutopilotState) -> Values:
    """Return the pulse widths of all outputs [µs]."""
    pulses = _pulses(state)
    return *pulses, *(_PWM_DISARMED,) * (_OUTPUTS - len(pulses))


def _armed(state: AutopilotState) -> bool:
    return state.status.arming is Arming.ARMED


def _commands(state: AutopilotState) -> tuple[float, ...]:
    return state.motors if _armed(state) else (0.0,) * len(state.motors)


def _pulses(state: AutopilotState) -> list[int]:
    if not _armed(state):
        return [_PWM_DISARMED] * len(state.motors)
    return [_PWM_MIN + units.saturate(_PWM_SPAN * u, 0, _PWM_SPAN, 0) for u in state.motors]
