"""Thermal soak: measured slowdown of a computer against its scripted slowdown."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from airl_mav.addons.profiling.measurement import ProfileRequest
from airl_mav.addons.profiling.soak import MachineReading, Soak, soak
from airl_mav.core.clock import SimClock
from airl_mav.core.machine import MachineState, throttled_since


@dataclass
class Computer:
    """Decides in 1 ms while it is cool, in 1.5 ms and with a slower clock from a time on."""

    warm_us: int
    clock: SimClock = field(default_factory=SimClock)
    decisions: int = 0
    tells: bool = True

    def decide(self) -> tuple[int, int]:
        start_us = self.clock.time_us()
        self.decisions += 1
        # One in fifty takes twice as long: the p99.
        took_us = 1_000 * (2 if self.decisions % 50 == 0 else 1)
        self.clock.advance(took_us if start_us < self.warm_us else took_us * 3 // 2)
        return start_us, self.clock.time_us()

    def read(self) -> MachineReading:
        now_us = self.clock.time_us()
        self.clock.advance(300)  # Looking takes time, which no decision is charged with.
        if not self.tells:
            return MachineReading(None, None, None)
        warm = now_us > self.warm_us
        return MachineReading(1200.0 if warm else 1500.0, 40.0 + now_us / 10e6, 6.0)

    def state(self) -> MachineState:
        warm = self.clock.time_us() > self.warm_us
        told = ("throttled" if warm else "none") if self.tells else None
        return MachineState(None, None, None, None, told, None)

    def soaked(self, seconds: float, stop_after_s: float = 1e9) -> Soak:
        return soak(
            self.decide,
            seconds,
            self.clock,
            read=self.read,
            state=self.state,
            stop=lambda: self.clock.time_us() > stop_after_s * 1e6,
        )


def test_a_computer_that_gets_slower_is_seen_to() -> None:
    soaked = Computer(warm_us=150_000_000).soaked(300.0)
    assert (soaked.asked_s, soaked.interrupted, soaked.window_s) == (300.0, False, 60.0)
    assert set(np.unique(soaked.first_us)) == {1_000, 2_000}
    assert set(np.unique(soaked.last_us)) == {1_500, 3_000}
    assert soaked.ends("frequency_mhz") == (1500.0, 1200.0)
    assert soaked.frequency_dropped
    assert soaked.throttled
    ends = soaked.ends("temperature_c")
    assert ends is not None
    assert ends == pytest.approx((43.0, 67.0), abs=0.2)  # Means over 0 to 60 s, 240 to 300 s.
    assert soaked.sentence() == (
        "soak of 5.0 min: t2 from the first to the last minute: p50 1.000 to 1.500 ms (+50%), p99 "
        "2.000 to 3.000 ms (+50%); frequency dropped (1500 to 1200 MHz); temperature "
        f"{ends[0]:.1f} to {ends[1]:.1f} °C; throttled"
    )


def test_the_series_has_every_decision_in_its_second() -> None:
    computer = Computer(warm_us=5_000_000)
    soaked = computer.soaked(10.0)
    series = soaked.series
    assert series["n"].sum() == computer.decisions
    assert len(series["time_s"]) == 10
    assert np.all(np.diff(series["time_s"]) > 0.99)
    assert soaked.duration_s == pytest.approx(10.0, abs=0.01)
    assert series["p50_ms"].tolist() == [1.0] * 5 + [1.5] * 5
    assert series["max_ms"].tolist() == [2.0] * 5 + [3.0] * 5
    # Halves, where there are no two minutes.
    assert soaked.window_s == pytest.approx(5.0, abs=0.01)
    assert soaked.last_us.size + soaked.first_us.size <= computer.decisions
    assert "to the last 5 s: p50 1.000 to 1.500 ms" in soaked.sentence()


def test_it_ends_early_with_what_was_measured() -> None:
    computer = Computer(warm_us=10**12)
    soaked = computer.soaked(600.0, stop_after_s=3.5)
    assert soaked.interrupted
    assert soaked.duration_s == pytest.approx(4.0, abs=0.01)
    assert soaked.series["n"].sum() == computer.decisions
    assert soaked.sentence().startswith("soak of 4 s of 10.0 min, interrupted: ")
    assert not soaked.frequency_dropped
    assert not soaked.throttled
    # Stopped before it began: one row all the same.
    only = Computer(warm_us=10**12).soaked(600.0, stop_after_s=0.0)
    assert len(only.series["time_s"]) == 1
    assert only.first_us.tolist() == only.last_us.tolist()


def test_what_the_machine_does_not_tell_is_said() -> None:
    soaked = Computer(warm_us=10**12, tells=False).soaked(20.0)
    assert (soaked.throttled, soaked.frequency_dropped) == (None, None)
    assert soaked.ends("temperature_c") is None
    for what in ("frequency", "temperature", "throttling"):
        assert f"{what}: not available" in soaked.sentence()
    assert np.isnan(soaked.series["power_w"]).all()
    facts = soaked.facts()
    assert (facts["temperature_c"], facts["throttled"]) == (None, None)
    assert facts["first_us"]["p50"] == 1_000.0


@pytest.mark.parametrize(
    ("before", "after", "throttled"),
    [
        (None, "none", None),
        ("none", None, None),
        ("none", "none", False),
        ("3 times since the start of the system", "3 times since the start of the system", False),
        ("3 times since the start of the system", "9 times since the start of the system", True),
        ("none", "throttling has occurred", True),
        ("throttling has occurred", "throttling has occurred", False),
        ("throttling has occurred", "throttled, throttling has occurred", True),
        ("throttled, throttling has occurred", "throttled, throttling has occurred", True),
    ],
)
def test_throttling_is_what_came_since(
    before: str | None, after: str | None, throttled: bool | None
) -> None:
    assert throttled_since(before, after) is throttled


def test_durations_have_units() -> None:
    for text, seconds in (("90s", 90.0), ("10min", 600.0), ("1.5 h", 5400.0), ("15000ms", 15.0)):
        assert ProfileRequest(soak=text).soak_s == seconds
    assert ProfileRequest().soak_s is None
