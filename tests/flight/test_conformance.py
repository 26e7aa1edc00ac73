"""Results of airl conformance: step responses, tolerances, reports, and Ctrl-C."""

from __future__ import annotations

import io
import json
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from airl_mav.addons.conformance import vehicle
from airl_mav.addons.conformance.checklist import (
    CheckDefinition,
    CheckFailedError,
    Checklist,
    CheckOutcome,
    NotApplicableError,
    Transcript,
    TranscriptLine,
    require,
)
from airl_mav.addons.conformance.command import ConformanceOptions, run
from airl_mav.addons.conformance.result import (
    ConformanceResult,
    ConformanceSettings,
    Reference,
    StoredStep,
    Tolerance,
    deviations,
)
from airl_mav.addons.conformance.telemetry import (
    BEFORE_S,
    MANOEUVRES,
    STEP_NAMES,
    EstimatedMotion,
    MeasuredStep,
    SetpointStep,
    StepResponse,
    TelemetryBuffer,
    measure,
    plan,
    step_response,
)
from airl_mav.addons.conformance.vehicle import Method, VehicleClock
from airl_mav.core.clock import SimClock
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import validated
from airl_mav.profiles.loading import list_profiles, load_profile
from airl_mav.profiles.px4_release import stored_release, version_name
from companion.link_interface import LinkError

RATE_HZ = 1000.0
SAMPLE_S = 1.0 / RATE_HZ
TIMES = np.arange(-1.0, 12.0, SAMPLE_S)


def first_order(times: np.ndarray, delay: float, tau: float) -> np.ndarray:
    return np.where(times > delay, 1.0 - np.exp(-(times - delay) / tau), 0.0)


def second_order(times: np.ndarray, delay: float, omega: float, zeta: float) -> np.ndarray:
    """Unit step response of an underdamped second-order system."""
    t = np.maximum(times - delay, 0.0)
    damped = omega * math.sqrt(1.0 - zeta**2)
    phase = math.acos(zeta)
    return 1.0 - np.exp(-zeta * omega * t) * np.sin(damped * t + phase) / math.sin(phase)


# --- step responses


@pytest.mark.parametrize(("before", "after"), [(0.0, 2.0), (2.0, 0.0), (0.0, -2.0), (-3.0, 5.0)])
@pytest.mark.parametrize(("delay", "tau"), [(0.0, 0.5), (0.1, 0.2)])
def test_first_order(before: float, after: float, delay: float, tau: float) -> None:
    values = before + (after - before) * first_order(TIMES, delay, tau)
    found = step_response(TIMES, values, before, after, 0.05)
    near = pytest.approx
    assert found.latency_s == near(
        delay - tau * math.log(1.0 - 0.05 / abs(after - before)), abs=SAMPLE_S
    )
    assert found.t10_s == near(delay - tau * math.log(0.9), abs=SAMPLE_S)
    assert found.t50_s == near(delay + tau * math.log(2.0), abs=SAMPLE_S)
    assert found.rise_s == near(tau * math.log(9.0), abs=SAMPLE_S)
    assert found.settle_s == near(delay + tau * math.log(20.0), abs=SAMPLE_S)
    assert found.overshoot_percent == near(0.0, abs=1e-6)
    assert found.error == near(0.0, abs=1e-6)


@pytest.mark.parametrize("zeta", [0.2, 0.5, 0.8])
@pytest.mark.parametrize(("before", "after"), [(0.0, 90.0), (30.0, -30.0)])
def test_second_order(before: float, after: float, zeta: float) -> None:
    omega, delay = 6.0, 0.07
    values = before + (after - before) * second_order(TIMES, delay, omega, zeta)
    found = step_response(TIMES, values, before, after, 0.5)
    overshoot = 100.0 * math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2))
    assert found.overshoot_percent == pytest.approx(overshoot, abs=0.01)
    # Where the curve itself, solved finely, passes the levels.
    fine = np.arange(0.0, 12.0, 1e-5)
    curve = second_order(fine, delay, omega, zeta)
    t10, t50, t90 = (fine[np.argmax(curve >= level)] for level in (0.1, 0.5, 0.9))
    assert found.t10_s == pytest.approx(t10, abs=SAMPLE_S)
    assert found.t50_s == pytest.approx(t50, abs=SAMPLE_S)
    assert found.rise_s == pytest.approx(t90 - t10, abs=SAMPLE_S)
    last = fine[np.flatnonzero(np.abs(curve - 1.0) > 0.05)[-1]]
    assert found.settle_s == pytest.approx(last, abs=2 * SAMPLE_S)


def test_a_time_is_that_of_the_first_sample_that_shows_it() -> None:
    times = np.arange(-0.5, 5.0, 0.01) + 0.003
    found = step_response(times, np.where(times >= 0.1, 1.0, 0.0), 0.0, 1.0, 0.05)
    assert found.latency_s == found.t10_s == found.t50_s == pytest.approx(0.103)
    assert found.rise_s == 0.0


def test_what_does_not_get_there_is_not_reached() -> None:
    values = 0.8 * first_order(TIMES, 0.0, 0.1)
    found = step_response(TIMES, values, 0.0, 1.0, 0.05)
    assert math.isnan(found.rise_s)
    assert math.isnan(found.settle_s)
    assert found.overshoot_percent == pytest.approx(-20.0, abs=0.01)
    assert found.error == pytest.approx(0.2, abs=1e-3)
    assert found.t50_s > 0.0


def test_latency_counts_from_the_mean_before_the_step_and_the_rest_from_the_setpoints() -> None:
    bias = 0.04
    values = bias + 2.0 * first_order(TIMES, 0.0, 0.5)
    found = step_response(TIMES, values, 0.0, 2.0, 0.05)
    assert found.latency_s == pytest.approx(-0.5 * math.log(1.0 - 0.025), abs=SAMPLE_S)
    assert found.t10_s == pytest.approx(-0.5 * math.log(1.0 - 0.08), abs=SAMPLE_S)
    assert found.error == pytest.approx(-bias, abs=1e-6)


@pytest.mark.parametrize("times", [np.arange(0.0, 5.0, 0.1), np.arange(-5.0, 0.0, 0.1)])
def test_telemetry_from_one_side_of_the_step_only_is_an_error(times: np.ndarray) -> None:
    with pytest.raises(ValueError, match="before and after"):
        step_response(times, np.zeros_like(times), 0.0, 1.0, 0.05)


def test_median_of_flights() -> None:
    one = StepResponse(0.1, 0.2, 0.3, 0.4, 5.0, 0.01, 1.0)
    other = StepResponse(0.2, 0.2, 0.3, 0.6, 7.0, -0.03, float("nan"))
    third = StepResponse(0.0, 0.1, 0.4, 0.5, 9.0, 0.00, 2.0)
    step = SetpointStep("north-2", "north", 0.0, 2.0)
    median = MeasuredStep(step, [one, other, third]).median
    assert median[:6] == pytest.approx((0.1, 0.2, 0.3, 0.5, 7.0, 0.0))
    assert math.isnan(median.settle_s)
    assert MeasuredStep(step, [one]).median == one


# --- steps read from telemetry


def a_motion(
    seconds: float, velocity: np.ndarray, yaw: np.ndarray, rate: np.ndarray
) -> EstimatedMotion:
    """Telemetry at 100 Hz; velocity (n, 3), yaw and rate (n,)."""
    times = 100.0 + np.arange(0.0, seconds, 0.01)
    position = np.column_stack([times, np.zeros((len(times), 3)), velocity])
    return EstimatedMotion(position, np.column_stack([times, yaw, rate]))


def test_forward_is_along_the_heading_before_the_step() -> None:
    n = 600
    after = np.arange(n) * 0.01 - BEFORE_S
    speed = 2.0 * first_order(after, 0.1, 0.3)
    yaw = math.radians(120.0)
    velocity = np.column_stack([speed * math.cos(yaw), speed * math.sin(yaw), np.zeros(n)])
    motion = a_motion(6.0, velocity, np.full(n, yaw), np.zeros(n))
    found = measure(SetpointStep("forward-2", "forward", 0.0, 2.0), motion, 100.0 + BEFORE_S)
    assert found.rise_s == pytest.approx(0.3 * math.log(9.0), abs=0.011)
    assert found.t50_s == pytest.approx(0.1 + 0.3 * math.log(2.0), abs=0.011)
    assert found.error == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("target", [90.0, -90.0, 170.0])
def test_heading_steps_in_degrees_across_any_wrap(target: float) -> None:
    n = 600
    share = second_order(np.arange(n) * 0.01 - BEFORE_S, 0.05, 6.0, 0.5)
    yaw = np.radians(target * share)
    wrapped = (yaw + math.pi) % (2.0 * math.pi) - math.pi
    motion = a_motion(6.0, np.zeros((n, 3)), wrapped, np.zeros(n))
    found = measure(SetpointStep("yaw-90", "heading", 0.0, target), motion, 100.0 + BEFORE_S)
    assert found.overshoot_percent == pytest.approx(16.3, abs=0.3)


def test_down_and_heading_rate_are_read_from_their_columns() -> None:
    n = 600
    share = first_order(np.arange(n) * 0.01 - BEFORE_S, 0.0, 0.2)
    velocity = np.column_stack([np.zeros(n), np.zeros(n), -2.0 * share])
    motion = a_motion(6.0, velocity, np.zeros(n), np.radians(30.0) * share)
    for step in (
        SetpointStep("up-2", "down", 0.0, -2.0),
        SetpointStep("yawspeed-30", "heading rate", 0.0, 30.0),
    ):
        found = measure(step, motion, 100.0 + BEFORE_S)
        assert found.rise_s == pytest.approx(0.2 * math.log(9.0), abs=0.011)


def test_every_step_is_flown_once_and_starts_where_the_leg_before_it_ends() -> None:
    legs = plan(STEP_NAMES, mirrored=False)
    assert [leg.step.name for leg in legs if leg.step] == list(STEP_NAMES)
    columns = {"north": 1, "east": 2, "down": 3, "forward": 1, "heading": 4, "heading rate": 4}
    for before, leg in pairwise(legs):
        if leg.step is None:
            continue
        column = columns[leg.step.quantity]
        assert before.setpoint[column] == leg.step.before
        assert leg.setpoint[column] == leg.step.after
        in_body = leg.step.quantity in ("forward", "heading rate")
        assert leg.setpoint.frame == ("body" if in_body else "ned")


def test_mirrored_flights_come_back() -> None:
    way = np.zeros(2)
    for mirrored in (False, True):
        for leg in plan(STEP_NAMES, mirrored=mirrored):
            # Facing north all the time: forward is north.
            way += np.array(leg.setpoint[1:3]) * leg.seconds
            assert leg.step is None or np.sign(leg.step.after - leg.step.before) != 0
    assert way == pytest.approx([0.0, 0.0])


def test_named_steps_alone_are_measured() -> None:
    legs = plan(("north-2-stop", "yaw-90"), mirrored=False)
    assert [leg.step.name for leg in legs if leg.step] == ["north-2-stop", "yaw-90"]
    assert len(legs) == len(MANOEUVRES[0]) + len(MANOEUVRES[5])


# --- stored columns


@pytest.mark.parametrize("name", list_profiles("conformance"))
def test_shipped_columns_are_whole(name: str) -> None:
    reference = load_profile("conformance", name, Reference)
    assert set(reference.steps) == set(STEP_NAMES)
    for stored in reference.steps.values():
        assert None not in (stored.latency_s, stored.rise_s, stored.overshoot_percent)


@pytest.mark.parametrize(
    ("firmware", "version", "column", "title"),
    [
        ("PX4", 0x01100040, "px4-1.16", "PX4 1.16.0 alpha"),
        ("PX4", 0x011002FF, "px4-1.16", "PX4 1.16.2"),
        ("PX4", 0x010E03FF, "px4-1.16", "PX4 1.14.3: no column; compared with 1.16"),
        ("ArduPilot", 0x04070000, "ardupilot-4.7", "ArduPilot 4.7.0 dev"),
        ("ArduPilot", 0x040503FF, "ardupilot-4.7", "ArduPilot 4.5.3: no column; compared with 4.7"),
        ("Betaflight", 0x040503FF, "", "Betaflight 4.5.3"),
    ],
)
def test_a_column_is_found_by_the_release(
    firmware: str, version: int, column: str, title: str
) -> None:
    assert stored_release(firmware, version) == (column, title)


def test_the_nearest_release_is_the_newest_for_one_to_come() -> None:
    newest = max(int(each[6:]) for each in list_profiles("conformance") if each[:6] == "px4-1.")
    column, title = stored_release("PX4", 1 << 24 | (newest + 1) << 16 | 0xFF)
    assert column == f"px4-1.{newest}"
    assert title == f"PX4 1.{newest + 1}.0: no column; compared with 1.{newest}"


STORED = StoredStep(latency_s=0.1, rise_s=1.0, overshoot_percent=3.0)


def response(latency_s: float = 0.1, rise_s: float = 1.0, overshoot: float = 3.0) -> StepResponse:
    return StepResponse(latency_s, 9.0, 9.0, rise_s, overshoot, 9.0, 9.0)


@pytest.mark.parametrize(
    ("measured", "outside"),
    [
        (response(), []),
        (response(latency_s=0.1099, rise_s=0.901, overshoot=7.9), []),
        (response(latency_s=0.0901, rise_s=1.099, overshoot=-4.0), []),
        (response(latency_s=0.1101), ["latency_s"]),
        (response(latency_s=0.0899), ["latency_s"]),
        (response(rise_s=1.101), ["rise_s"]),
        (response(rise_s=0.899), ["rise_s"]),
        (response(overshoot=8.1), ["overshoot_percent"]),
        (response(latency_s=math.nan, rise_s=math.nan), ["latency_s", "rise_s"]),
    ],
)
def test_tolerances(measured: StepResponse, outside: list[str]) -> None:
    assert [each.figure for each in deviations(measured, STORED, Tolerance())] == outside


def test_a_short_time_may_be_off_by_a_sample() -> None:
    short = StoredStep(latency_s=0.035)
    assert not deviations(response(latency_s=0.0449), short, Tolerance())
    assert deviations(response(latency_s=0.0451), short, Tolerance())


def test_overshoot_that_is_missing_is_a_miss() -> None:
    stored = StoredStep(overshoot_percent=15.0)
    (found,) = deviations(response(overshoot=-3.0), stored, Tolerance())
    assert found.figure == "overshoot_percent"


# --- checks and transcript


def a_checklist() -> tuple[Checklist, list[TranscriptLine]]:
    shown: list[TranscriptLine] = []
    return Checklist(Transcript(SimClock(), shown.append)), shown


def a_result(checklist: Checklist, **found: Any) -> ConformanceResult:
    return ConformanceResult(ConformanceSettings(), checklist.checks, **found)


def test_checks_and_what_they_find() -> None:
    checklist, shown = a_checklist()

    def fails() -> str:
        require(False, "too slow")
        return "never"

    def says_nothing() -> str:
        raise NotApplicableError("no rangefinder")

    assert checklist.perform("first", lambda: "quick")
    assert checklist.perform("second", says_nothing)
    assert a_result(checklist).passed
    assert not checklist.perform("third", fails)
    assert not a_result(checklist).passed
    outcomes = [(check.name, check.outcome, check.finding) for check in checklist.checks]
    assert outcomes == [
        ("first", CheckOutcome.PASSED, "quick"),
        ("second", CheckOutcome.NOT_APPLICABLE, "no rangefinder"),
        ("third", CheckOutcome.FAILED, "too slow"),
    ]
    assert [line.text for line in shown][-1] == "third: fail: too slow"


@pytest.mark.parametrize("error", [LinkError("gone"), KeyboardInterrupt()])
def test_what_ends_a_flight_is_noted_and_goes_on(error: BaseException) -> None:
    checklist, _ = a_checklist()

    def breaks() -> str:
        raise error

    with pytest.raises(type(error)):
        checklist.perform("flight", breaks)
    (check,) = checklist.checks
    assert check.outcome is CheckOutcome.FAILED
    assert check.finding == (str(error) or "interrupted")


def test_nothing_checked_is_nothing_passed() -> None:
    checklist, _ = a_checklist()
    assert not a_result(checklist).passed


def test_a_failed_essential_check_ends_its_table_and_steps_alone_need_fewer() -> None:
    def fails(vehicle: str) -> str:
        raise CheckFailedError(vehicle)

    table = (
        CheckDefinition("one", str.upper),
        CheckDefinition("two", fails, for_steps=True),
        CheckDefinition("three", fails, essential=True, for_steps=True),
        CheckDefinition("four", str.upper, for_steps=True),
    )
    for steps_only, names in ((False, ["one", "two", "three"]), (True, ["two", "three"])):
        checklist, _ = a_checklist()
        assert not checklist.perform_all(table, "quad", steps_only=steps_only)
        assert [check.name for check in checklist.checks] == names
    assert checklist.perform_all(table[:2], "quad")


@pytest.mark.parametrize(
    ("found", "verdict"),
    [
        ({}, "FAILED: 1 passed, 1 failed, 0 not applicable: land"),
        (
            {"interrupted": True, "firmware": "PX4 1.17.0"},
            "INTERRUPTED: 1 passed, 1 failed, 0 not applicable; PX4 1.17.0",
        ),
        (
            {"known_to_be_down": False},
            "FAILED: 1 passed, 1 failed, 0 not applicable: land; NOT known to be down",
        ),
    ],
)
def test_verdict(found: dict[str, Any], verdict: str) -> None:
    checklist, _ = a_checklist()
    checklist.perform("arm", lambda: "armed")
    checklist.perform("land", lambda: require(False, "not reached"))
    result = a_result(checklist, **found)
    assert result.verdict == verdict
    assert not result.passed


def test_repeated_lines_are_counted() -> None:
    shown: list[TranscriptLine] = []
    transcript = Transcript(SimClock(2_500_000), shown.append)
    for text in ("a", "b", "b", "b", "c"):
        transcript.add("heard", text)
    assert [line.text for line in shown] == ["a", "b", "... and 2 times more", "c"]
    assert transcript.lines == shown
    assert shown[0].time_s == 2.5


@pytest.mark.parametrize(
    ("number", "name"),
    [
        (17825856, "1.16.0 alpha"),  # PX4 main of 2025-02
        (67567616, "4.7.0 dev"),  # ArduCopter of 2025-07
        (0x010E03FF, "1.14.3"),
        (0x040503C0, "4.5.3 rc"),
    ],
)
def test_versions(number: int, name: str) -> None:
    assert version_name(number) == name


def test_columns_say_where_they_come_from() -> None:
    for path in (Path(__file__).parents[2] / "profiles" / "conformance").glob("*.toml"):
        assert len(load_profile("conformance", str(path), Reference).source) > 40


# --- the command


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": ("north-3",)}, "steps 'north-3': accepted: north-2, "),
        ({"steps": ()}, "steps: accepted: one name or more"),
        ({"speed": 0.0}, "speed 0: accepted: 0.01 <= value <= 100"),
        ({"speed": math.nan}, "speed nan: accepted: 0.01 <= value <= 100"),
        ({"altitude_m": 7.0}, "altitude_m 7: accepted: 8 <= value <= 100"),
        ({"altitude_m": 1.0, "steps_only": True}, "altitude_m 1: accepted: 2 <= value <= 100"),
        ({"repeat": 0}, "repeat 0: accepted: 1 <= value <= 20"),
        ({"connect_timeout_s": 0.0}, "connect_timeout_s 0: accepted: 1 <= value <= 3600"),
        ({"reference": "betaflight"}, "'betaflight'; shipped: ardupilot-4.7, "),
        ({"out": Path("no/such/folder/x.json")}, "out 'no/such/folder/x.json': no folder"),
        ({"skip_steps": True, "steps_only": True}, "skip_steps: accepted: without --steps-only"),
        ({"skip_steps": True, "steps": ("yaw-90",)}, "skip_steps: accepted: without --steps"),
    ],
)
def test_input_that_cannot_be_used(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as error:
        run(validated(ConformanceOptions, options), Console(file=io.StringIO()))
    assert message in str(error.value)


@pytest.mark.parametrize("url", ["nonsense", "udpin://127.0.0.1:not-a-port"])
def test_a_connection_that_cannot_be(url: str) -> None:
    with pytest.raises(UsageError, match=re.escape(f"--connect {url}: ")):
        run(ConformanceOptions(connect=url), Console(file=io.StringIO()))


# --- what is heard


class Message:
    """A message as mavlink_direct hands it over."""

    def __init__(self, message_name: str, component_id: int = 1, **fields: Any) -> None:
        self.message_name, self.component_id = message_name, component_id
        self.fields_json = json.dumps(fields)


def a_telemetry() -> tuple[TelemetryBuffer, list[str]]:
    shown: list[str] = []
    return TelemetryBuffer(Transcript(SimClock(), lambda line: shown.append(line.text))), shown


def a_text(text: str, number: int = 0, part: int = 0) -> Message:
    return Message("STATUSTEXT", severity=2, text=text, id=number, chunk_seq=part)


def test_long_texts_are_put_together() -> None:
    telemetry, shown = a_telemetry()
    whole = "Arming denied: Resolve system health failures first, then again"
    for message in (a_text(whole[:50], 7), a_text(whole[50:] + "\t", 7, 1), a_text("Armed", 8)):
        telemetry.receive(message, None)
    assert [text.text for text in telemetry.texts] == [whole, "Armed"]
    assert shown == [f'STATUSTEXT 2 "{whole}"', 'STATUSTEXT 2 "Armed"']
    assert telemetry.find_text("Armed") is not None
    assert telemetry.find_text("Arming", since=1) is None


def test_only_changes_of_a_heartbeat_are_told() -> None:
    telemetry, shown = a_telemetry()
    beat = {"custom_mode": 4, "base_mode": 81, "system_status": 3, "autopilot": 3, "type": 2}
    for base_mode in (81, 81, 209, 209):
        telemetry.receive(Message("HEARTBEAT", **{**beat, "base_mode": base_mode}), None)
    telemetry.receive(Message("HEARTBEAT", component_id=154, **{**beat, "custom_mode": 0}), None)
    assert shown == [
        "HEARTBEAT 4, disarmed, system_status 3",
        "HEARTBEAT 4, armed, system_status 3",
    ]


def test_motion_by_the_vehicles_clock() -> None:
    telemetry, _ = a_telemetry()
    for time_boot_ms in range(1000, 3000, 10):
        position: dict[str, Any] = {"x": 1.0, "y": 2.0, "z": -3.0, "vx": None, "vy": 0.5, "vz": 0.0}
        telemetry.receive(
            Message("LOCAL_POSITION_NED", time_boot_ms=time_boot_ms, **position), None
        )
        telemetry.receive(
            Message("ATTITUDE", time_boot_ms=time_boot_ms, yaw=0.1, yawspeed=0.2), None
        )
    motion = telemetry.recent(0.5)
    assert motion.position[0, 0] == pytest.approx(2.49)
    assert motion.position[-1, 0] == telemetry.boot_s == pytest.approx(2.99)
    assert len(motion.heading) == len(motion.position) == 51
    assert np.isnan(motion.position[0, 4])
    part = motion.between(2.6, 2.7)
    assert part.position[:, 0] == pytest.approx(np.arange(2.6, 2.705, 0.01))


class Vehicle:
    """Answers, or not."""

    def __init__(self, telemetry: TelemetryBuffer, *methods: Method) -> None:
        self.telemetry, self.methods = telemetry, methods
        self.clock = VehicleClock(telemetry, self.send, speed=0.0)

    def send(self, name: str, fields: dict[str, object]) -> None:
        if name == "TIMESYNC" and Method.TIMESYNC in self.methods:
            answer = Message(name, tc1=5_125_000_000, ts1=fields["ts1"])
            self.clock.receive(answer, None)
        elif name == "COMMAND_LONG" and Method.SYSTEM_TIME in self.methods:
            assert (fields["command"], fields["param1"]) == (512, 2)
            self.telemetry.receive(Message("COMMAND_ACK", command=512, result=0), None)
            self.clock.receive(Message("SYSTEM_TIME", time_boot_ms=5125), None)


@pytest.mark.parametrize(
    ("methods", "chosen", "told"),
    [
        ((Method.TIMESYNC, Method.SYSTEM_TIME), Method.TIMESYNC, (5.125, True)),
        ((Method.SYSTEM_TIME,), Method.SYSTEM_TIME, (5.125, True)),
        ((), Method.TELEMETRY, (5.1, False)),
    ],
)
def test_the_time_is_asked_for_in_the_way_that_is_answered(
    methods: tuple[Method, ...],
    chosen: Method,
    told: tuple[float, bool],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(vehicle, "ANSWER_S", 0.02)
    telemetry, shown = a_telemetry()
    clock = Vehicle(telemetry, *methods).clock
    telemetry.boot_s = 5.1
    assert clock.choose_method() is chosen
    sent_s = clock.sending_time()
    assert sent_s == pytest.approx(told[0])
    assert (clock.inexact == 0) is told[1]
    assert not shown, "its own answers are no news"


def test_another_clock_is_not_taken_for_telemetrys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vehicle, "ANSWER_S", 0.02)
    telemetry, _ = a_telemetry()
    clock = Vehicle(telemetry, Method.TIMESYNC).clock
    telemetry.boot_s = 1_700.0
    assert clock.choose_method() is Method.TELEMETRY


def test_of_exchanges_the_first_short_one_is_taken_and_the_time_since_added(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    telemetry, _ = a_telemetry()
    now_us = [0]
    round_trips_us = [50_000, 9_000, 1_500, 1_000]

    def send(name: str, fields: dict[str, object]) -> None:
        # The vehicle's clock: twice as fast, 10 s ahead; it answers in the middle.
        way_us = round_trips_us.pop(0) // 2
        now_us[0] += way_us
        tc1 = 10_000_000_000 + 2 * now_us[0] * 1000
        now_us[0] += way_us
        clock.receive(Message(name, tc1=tc1, ts1=fields["ts1"]), None)

    clock = VehicleClock(telemetry, send, speed=2.0)
    monkeypatch.setattr(clock.wall, "time_us", lambda: now_us[0])
    sent_s = clock.sending_time()
    assert not clock.inexact
    assert round_trips_us == [1_000]
    assert sent_s == pytest.approx(10.0 + 2e-6 * now_us[0], abs=1e-9)
