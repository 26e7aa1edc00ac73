"""What the motors are told, and what their speed controllers report."""

from __future__ import annotations

from firmware_sim.autopilot import esc
from firmware_sim.autopilot.autopilot_state import Arming, AutopilotState
from firmware_sim.mavlink.codec import Values, dialect
from firmware_sim.mavlink.px4_custom_mode import base_mode
from firmware_sim.mavlink.streams import units

_PWM_DISARMED, _PWM_MIN, _PWM_SPAN = 900, 1_000, 1_000
"""Pulse widths [µs] of PX4's simulated outputs (src/modules/simulation/pwm_out_sim)."""

_OUTPUTS = 16
"""Of PX4's simulation. Those that drive no motor stay at the disarmed pulse."""

_OUTPUT_FIELDS = 32
"""Slots of ACTUATOR_OUTPUT_STATUS."""

_NO_FAILURES = (0, 0, 0, 0)
_FIRST_ESC = 0
_ESCS = 4


def actuator_output_status(state: AutopilotState) -> Values:
    """The same pulse widths as an array of 16 outputs in use."""
    return state.time_us, _OUTPUTS, *_outputs(state), *(0,) * (_OUTPUT_FIELDS - _OUTPUTS)


def hil_actuator_controls(state: AutopilotState) -> Values:
    """Motor commands 0..1, zero while disarmed; 16 controls."""
    commands, flags = _commands(state), 0
    unused = (0.0,) * (_OUTPUTS - len(commands))
    return state.time_us, *commands, *unused, base_mode(state.status), flags


def esc_info(state: AutopilotState) -> Values:
    """Four speed controllers, all of them on line; temperature [0.01 °C]."""
    counter, online = 0, (1 << _ESCS) - 1
    temperature = (units.int16((esc.IDLE_C + esc.SPAN_C * u) * 100.0) for u in _outputs_of(state))
    return (
        *(_FIRST_ESC, state.time_us, counter, _ESCS),
        *(dialect.ESC_CONNECTION_TYPE_PPM, online),
        *_NO_FAILURES,
        *_NO_FAILURES,
        *temperature,
    )


def esc_status(state: AutopilotState) -> Values:
    """Speed [rpm], voltage [V] and current [A] of four speed controllers."""
    outputs = _outputs_of(state)
    return (
        *(_FIRST_ESC, state.time_us),
        *(round(esc.RPM * u) for u in outputs),
        *(state.battery.voltage_v,) * _ESCS,
        *_currents_a(state, outputs),
    )


def _outputs_of(state: AutopilotState) -> tuple[float, ...]:
    """Return what the motors do: what they are told, where nothing else is known."""
    commands = _commands(state)
    return commands if state.esc_outputs is None else state.esc_outputs


def _currents_a(state: AutopilotState, outputs: tuple[float, ...]) -> tuple[float, ...]:
    if state.esc_outputs is None and _armed(state):
        # As PX4 has it: armed, a motor draws its idle current, turning or not.
        return tuple(esc.IDLE_A + esc.SPAN_A * u for u in outputs)
    return tuple(esc.current_a(u) for u in outputs)


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
