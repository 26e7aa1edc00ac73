"""Latency and speed options of `airl train`."""

from __future__ import annotations

from typing import Any

import pytest

from airl_mav.core.errors import UsageError
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec, spec_of
from airl_mav.envs.stopping import injections_of
from airl_mav.training.config import TrainingConfig, configured

LATE = {"computer": "ras-pi-4", "workload": "template-7x32", "link_ms": 7.0}


def environment_of(configuration: EnvironmentSpec, **changes: Any) -> EnvironmentSpec:
    config = TrainingConfig(description="any", environment=configuration)
    return configured(config, **changes).environment


def test_nothing_asked_changes_nothing() -> None:
    late = spec_of(None, {"delay": LATE, "safe_velocity": {"sensing_distance_m": 2.0}})
    assert environment_of(late) == late
    assert environment_of(EnvironmentSpec()) == EnvironmentSpec()


def test_the_latency_of_a_computer() -> None:
    source = {"computer": "ras-pi-4", "workload": "template-5x32"}
    delay = environment_of(EnvironmentSpec(), **source).delay
    (injection,) = injections_of(delay)
    assert injection.latency is not None
    assert injection.latency.mean_ms == 396.0


def test_a_source_takes_the_place_of_the_configured_one_alone() -> None:
    latency = ("150ms", "ras-pi-4/template-5x32")
    delay = environment_of(spec_of(None, {"delay": LATE}), latency=latency).delay
    assert (delay.computer, delay.workload, delay.link_ms) == ("workstation", None, 7.0)
    means = [i.latency.mean_ms for i in injections_of(delay) if i.latency is not None]
    assert means == [150.0, 396.0]
    # ... and an environment flies with both.
    navigation = Navigation(spec_of(None, {"arena": "no-obstacles", "delay": delay}), 2)
    assert [each.label for each in navigation.injections] == [
        each.label for each in injections_of(delay)
    ]


def test_the_sensing_distance() -> None:
    safe = environment_of(EnvironmentSpec(), sensing_distance_m=3.0).safe_velocity
    assert safe is not None
    assert safe.sensing_distance_m == 3.0


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"computer": "ras-pi-4"}, "takes workload: template-5x32"),
        ({"workload": "template-5x32"}, "with computer"),
        (
            {"computer": "ras-pi-4", "workload": "template-5x32", "latency": ("150ms",)},
            "without computer",
        ),
        ({"seed": -1}, "seed -1"),
        ({"steps": 0}, "steps 0"),
        ({"sensing_distance_m": 0.0}, "safe_velocity.sensing_distance_m 0"),
    ],
)
def test_what_does_not_go_together_gets_one_line(asked: dict[str, Any], told: str) -> None:
    with pytest.raises(UsageError) as refused:
        environment_of(EnvironmentSpec(), **asked)
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)
