"""How late, and how fast, `airl train` is asked to train."""

from __future__ import annotations

from typing import Any

import pytest

from airl_mav.cli.train_command import TrainCommand
from airl_mav.cli.train_environment import environment_of
from airl_mav.core.errors import UsageError
from airl_mav.envs.delay import injections_of
from airl_mav.envs.navigation import Navigation
from airl_mav.envs.spec import EnvironmentSpec, spec_of

LATE = {"computer": "ras-pi-4", "workload": "template-7x32", "link_ms": 7.0}


def test_nothing_asked_changes_nothing() -> None:
    configured = spec_of(None, {"delay": LATE, "safe_velocity": {"sensing_distance_m": 2.0}})
    assert environment_of(TrainCommand(), configured) == configured
    assert environment_of(TrainCommand(), EnvironmentSpec()) == EnvironmentSpec()


def test_the_latency_of_a_computer() -> None:
    command = TrainCommand(computer="ras-pi-4", workload="template-5x32")
    delay = environment_of(command, EnvironmentSpec()).delay
    (injection,) = injections_of(delay)
    assert injection.latency is not None
    assert injection.latency.mean_ms == 396.0


def test_a_source_takes_the_place_of_the_configured_one_alone() -> None:
    command = TrainCommand(latency=("150ms", "ras-pi-4/template-5x32"))
    delay = environment_of(command, spec_of(None, {"delay": LATE})).delay
    assert (delay.computer, delay.workload, delay.link_ms) == ("workstation", None, 7.0)
    means = [i.latency.mean_ms for i in injections_of(delay) if i.latency is not None]
    assert means == [150.0, 396.0]
    # ... and an environment flies with both.
    navigation = Navigation(spec_of(None, {"arena": "no-obstacles", "delay": delay}), 2)
    assert [each.label for each in navigation.injections] == [
        each.label for each in injections_of(delay)
    ]


def test_the_sensing_distance() -> None:
    command = TrainCommand(sensing_distance=3.0, max_acceleration=6.0)
    safe = environment_of(command, EnvironmentSpec()).safe_velocity
    assert safe is not None
    assert (safe.sensing_distance_m, safe.max_acceleration_m_s2) == (3.0, 6.0)


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"computer": "ras-pi-4"}, "takes --workload: template-5x32"),
        ({"workload": "template-5x32"}, "with --computer"),
        (
            {"computer": "ras-pi-4", "workload": "template-5x32", "latency": ("150ms",)},
            "one of them",
        ),
        ({"max_acceleration": 4.0}, "with --sensing-distance"),
        ({"sensing_distance": 0.0}, "safe_velocity.sensing_distance_m 0"),
    ],
)
def test_what_does_not_go_together_gets_one_line(asked: dict[str, Any], told: str) -> None:
    with pytest.raises(UsageError) as refused:
        environment_of(TrainCommand(**asked), EnvironmentSpec())
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)
