"""Conversion of vectorized simulator environments to lockstep scenarios."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from typing import Any

from airl_mav.core.errors import FieldError
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.profiles.conditions import SensorNoise, Spread
from airl_mav.scenario.model import Scenario, WatchdogSettings

BESIDE = (
    "firmware",
    "real",
    "plant",
    "estimator",
    "renderer",
    "faults",
    "payload",
    "battery_charge",
    "origin",
    "limits",
    "arena_seed",
    "latency_seed",
    "speed",
    "start",
)
"""Fields of a `Scenario` that an `EnvironmentSpec` lacks."""

TWIN_ALONE = (
    "camera",
    "curriculum",
    "delay.native_ms",
    "delay.transport_ms",
    "delay.link_ms",
    "randomisation.estimation",
    "randomisation.extra_delay_ms",
)
"""Fields of an `EnvironmentSpec` that only the vectorized simulator supports."""


def scenario_of(spec: EnvironmentSpec, beside: Mapping[str, Any]) -> Scenario:
    """Return the scenario, without a policy; of several t2 sources it uses the first.

    Args:
        spec: Specification of the environment.
        beside: Values of the fields `BESIDE`, without defaults.

    Raises:
        FieldError: A field has a wrong type, is out of range, or needs the vectorized simulator.
    """
    usual = EnvironmentSpec()
    for name in TWIN_ALONE:
        value, accepted = (reduce(getattr, name.split("."), each) for each in (spec, usual))
        if value != accepted:
            raise FieldError(name, value, f"{accepted}: only the batch twin has another")
    rules, delay, drawn = spec.episode, spec.delay, spec.randomisation
    return Scenario(
        level="lockstep",
        vehicle=spec.vehicle,
        arena=spec.arena,
        hold_s=rules.hold_s,
        altitude_m=rules.altitude_m,
        goal_radius_m=rules.goal_radius_m,
        time_limit_s=rules.time_limit_s,
        max_speed_m_s=spec.max_speed_m_s,
        decisions=spec.decisions,
        compensate=spec.compensate,
        watchdog=WatchdogSettings(
            hover_after_s=rules.hover_after_s, decision_timeout_s=rules.decision_timeout_s
        ),
        computer=delay.computer,
        workload=delay.workload,
        latency=delay.latency[0] if delay.latency else None,
        wind=spec.wind,
        spread={name: getattr(drawn, name) for name in Spread.model_fields},
        sensors={name: getattr(drawn, name) for name in SensorNoise.model_fields},
        **beside,
    )
