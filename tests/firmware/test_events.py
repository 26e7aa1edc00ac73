"""MAVLink events: their numbers, words and reports, as sent and as MAVSDK understands them."""

from __future__ import annotations

import json
import lzma
import math
import re
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from mavsdk.plugins.action import Action, ActionError
from mavsdk.plugins.events import Events, EventsError, LogLevel
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage

from airl_mav.core.constants import US_PER_S
from airl_mav.core.frames import Geodetic
from airl_mav.profiles.px4_release import CURRENT, PX4ReleaseName
from firmware_sim.addons.ground_station_services import component_metadata
from firmware_sim.addons.ground_station_services.component_metadata import definitions
from firmware_sim.autopilot.autopilot_state import OperatorText, Result, Severity
from firmware_sim.autopilot.events import flight_events
from firmware_sim.autopilot.events.definition import (
    ENUMERATIONS,
    FORMATS,
    ArmingReason,
    Component,
    FailsafeAction,
    FailsafeCause,
    Level,
    MavlinkEvent,
    ModeGroup,
    sub_id,
)
from firmware_sim.autopilot.events.health_report import ALL_MODES, HealthReport, health_report
from firmware_sim.autopilot.failsafes.failsafe_conditions import BatteryWarning, Conditions
from firmware_sim.autopilot.failsafes.framework import announcement
from firmware_sim.autopilot.flight_modes import Mode, Need
from firmware_sim.autopilot.modes.interface import Source, Sticks
from firmware_sim.autopilot.prearm import ArmingSettings, Readiness, can_arm, failing
from firmware_sim.autopilot.sensor_monitor import ACCEL, BARO, GPS, GYRO, MAG, SensorWatch
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.texts_and_events import FIRST_SEQUENCE, KEPT
from tests.support import flight_rig
from tests.support.flown_by_mavsdk import Flown, flown
from tests.support.mavlink_clients import RawClient, Rig, wait_for

RESET = dialect.MAV_EVENT_CURRENT_SEQUENCE_FLAGS_RESET
READY = Readiness(Mode.HOLD, Conditions(), ArmingSettings())


def metadata() -> dict[str, Any]:
    """Return what the file on board says of the autopilot's events."""
    packed = component_metadata.files(CURRENT)["all_events.json.xz"]
    component: dict[str, Any] = json.loads(lzma.decompress(packed))["components"]["1"]
    return component


def read(event: MavlinkEvent) -> tuple[str, list[Any]]:
    """Return an event's message and arguments, decoded by the file as a ground station does."""
    component = metadata()
    for group in component["event_groups"].values():
        described = group["events"].get(str(event.number & 0xFFFFFF))
        if described is None:
            continue
        kinds = [argument["type"] for argument in described.get("arguments", ())]
        enums = [component["enums"].get(kind) for kind in kinds]
        layout = "<" + "".join(
            FORMATS[enum["type"] if enum else kind] for enum, kind in zip(enums, kinds, strict=True)
        )
        values = struct.unpack_from(layout, event.arguments.ljust(40, b"\0"))
        words = [
            enum["entries"].get(str(value), {}).get("description", value) if enum else value
            for enum, value in zip(enums, values, strict=True)
        ]
        parts = re.split(r"\{(\d)[^}]*\}", described["message"])
        parts[1::2] = [str(words[int(place) - 1]) for place in parts[1::2]]
        return "".join(parts), list(values)
    raise AssertionError(f"no words for event {event.number:#x}")


def messages(report: HealthReport) -> list[str]:
    return [read(event)[0] for event in report.checks]


# --- definitions


def test_an_events_number_is_the_hash_of_its_name() -> None:
    # Test vectors of FNV-1a with 32 bits, http://www.isthe.com/chongo/src/fnv/test_fnv.c
    assert sub_id("") == 0x811C9DC5 & 0xFFFFFF
    assert sub_id("a") == 0xE40C292C & 0xFFFFFF
    assert sub_id("foobar") == 0xBF9CF968 & 0xFFFFFF
    assert flight_events.ARMED_BY.number == 1 << 24 | sub_id("commander_armed_by")


def test_every_event_has_a_number_of_its_own_and_room_for_its_arguments() -> None:
    listed = list({definition.name: definition for definition in definitions(CURRENT)}.values())
    assert len({definition.number for definition in listed}) == len(listed) > 50
    for definition in listed:
        event = definition.event(*[0] * len(definition.arguments))
        assert len(event.arguments) <= 25  # PX4's limit
        highest = max([int(n) for n in re.findall(r"\{(\d)", definition.message)], default=0)
        assert highest <= len(definition.arguments)


def test_the_words_on_board_describe_every_event_and_enumeration() -> None:
    component = metadata()
    described = {
        int(number): event["name"]
        for group in component["event_groups"].values()
        for number, event in group["events"].items()
    }
    assert described == {sub_id(d.name): d.name for d in definitions(CURRENT)}
    assert component["enums"].keys() == ENUMERATIONS.keys()
    groups = component["navigation_mode_groups"]["groups"]
    assert groups["4"] == [Mode.HOLD.spec.custom_mode] and groups["18"] == [
        Mode.LAND.spec.custom_mode
    ]
    assert component["supported_protocols"] == ["health_and_arming_check"]


@pytest.mark.parametrize("value", [3e38, -3e38, 1e300, -1e300, math.inf, -math.inf, math.nan])
def test_an_event_can_be_made_of_any_numbers(value: float) -> None:
    """Out-of-range values are clamped: no event may end a flight."""
    for definition in definitions(CURRENT):
        happened = definition.event(*[value] * len(definition.arguments))
        _, values = read(happened)
        for argument, told in zip(definition.arguments, values, strict=True):
            listed = ENUMERATIONS.get(argument.kind)
            if argument.kind == "float":
                assert math.isnan(told) is math.isnan(value)
            elif (listed.base if listed else argument.kind)[0] == "u":
                assert (told > 0) is (value > 0.0)
            else:
                assert (told < 0) is (value < 0.0)


def test_a_return_to_a_home_beyond_all_bounds_is_told() -> None:
    """Two commands of any client ended the flight controller: DO_SET_HOME, and Return."""
    rig = flight_rig.Rig()
    rig.boot()
    for altitude_m in (3e38, -3e38):
        rig.ap.arm(force=False)  # Arming sets home.
        assert rig.ap.set_home(Geodetic(90.0, 180.0, altitude_m)) is Result.ACCEPTED
        rig.ap.take_events()
        assert rig.ap.set_mode(Mode.RETURN) is Result.ACCEPTED
        told = [read(event)[0] for event in rig.ap.take_events()]
        assert sum(words.startswith("RTL: start return at") for words in told) == 1
        rig.ap.set_mode(Mode.HOLD)
        rig.run(0.5)
    rig.close()


def test_levels_are_two_halves_of_a_byte() -> None:
    denied = flight_events.ARM_DENIED.event()
    assert denied.levels == Level.INFO << 4 | Level.CRITICAL
    assert flight_events.ARMED_BY.event(ArmingReason.COMMAND_EXTERNAL).levels == 0x66


@pytest.mark.parametrize(
    ("action", "delayed", "cause", "expected"),
    [
        (
            FailsafeAction.HOLD,
            FailsafeAction.RTL,
            FailsafeCause.GCS_CONNECTION_LOSS,
            "GCS connection loss: switching to Return in 5 seconds",
        ),
        (
            FailsafeAction.HOLD,
            FailsafeAction.LAND,
            FailsafeCause.GENERIC,
            "Failsafe activated: switching to Land in 5 seconds",
        ),
        (
            FailsafeAction.WARN,
            FailsafeAction.NONE,
            FailsafeCause.LOW_BATTERY_LEVEL,
            "Low battery level, return advised",
        ),
        (
            FailsafeAction.DESCEND,
            FailsafeAction.NONE,
            FailsafeCause.GENERIC,
            "Failsafe activated: Autopilot disengaged, switching to Descend",
        ),
        (
            FailsafeAction.RTL,
            FailsafeAction.NONE,
            FailsafeCause.CRITICAL_BATTERY_LEVEL,
            "Critical battery level: switching to Return",
        ),
    ],
)
def test_a_failsafes_event_names_its_cause_and_what_follows(
    action: FailsafeAction, delayed: FailsafeAction, cause: FailsafeCause, expected: str
) -> None:
    told = announcement(action, delayed, cause, Mode.OFFBOARD, 5 * US_PER_S)
    assert told.event is not None
    words, values = read(told.event)
    assert words == expected
    assert not values or values[0] == Mode.OFFBOARD.spec.custom_mode


# --- the report


def test_a_healthy_vehicle_reports_what_some_modes_lack() -> None:
    report = health_report(READY)
    assert messages(report) == [
        "No connection to the ground control station",
        "No valid mission available",
        "No offboard signal",
        "No manual control input",
    ]
    lacking = ModeGroup.MISSION | ModeGroup.OFFBOARD | ModeGroup.MANUAL | ModeGroup.STAB
    assert not report.can_arm & lacking and not report.can_run & lacking
    assert report.can_arm & report.can_run & ModeGroup.LOITER
    assert report.arming_error == Component.SYSTEM  # the offboard signal
    assert report.arming_warning == Component.REMOTE_CONTROL


def test_what_keeps_all_modes_from_arming_says_so() -> None:
    report = health_report(READY._replace(baro=False))
    assert report.can_arm == 0 and report.can_run & ModeGroup.LOITER
    assert report.health_error == Component.ABSOLUTE_PRESSURE
    words, (modes, part, instance) = read(report.checks[0])
    assert words == "No valid data from barometer 0"
    assert (modes, 1 << part, instance) == (ALL_MODES, Component.ABSOLUTE_PRESSURE, 0)


def test_a_check_of_the_position_leaves_modes_without_it() -> None:
    lost = READY.conditions._replace(
        local_position_invalid=True,
        local_position_invalid_relaxed=True,
        global_position_invalid=True,
        manual_control_signal_lost=False,
    )
    report = health_report(READY._replace(conditions=lost))
    assert report.can_arm & ModeGroup.STAB and report.can_run & ModeGroup.ALTCTL
    assert not report.can_arm & (ModeGroup.LOITER | ModeGroup.POSCTL | ModeGroup.TAKEOFF)


@pytest.mark.parametrize("mode", Mode)
def test_the_report_agrees_with_what_arming_is_refused_for(mode: Mode) -> None:
    if mode.spec.needs & Need.NOT_ARMING:
        pytest.skip("what no mode of its kind can do is told only in that mode")
    for faulty in (
        READY,
        READY._replace(gps=False),
        READY._replace(mag=False),
        READY._replace(conditions=Conditions(local_position_invalid=True)),
        READY._replace(conditions=Conditions(auto_mission_missing=False)),
        READY._replace(conditions=Conditions(offboard_control_signal_lost=False)),
    ):
        report, here = health_report(faulty), faulty._replace(mode=mode)
        assert (report.can_arm & mode.spec.state_bits == mode.spec.state_bits) is not bool(
            can_arm(here)
        )


FAULTY = READY._replace(
    mode=Mode.OFFBOARD,
    conditions=Conditions(battery_warning=BatteryWarning.LOW, fd_motor_failure=True),
    compass_agrees=False,
    distance=False,
    failed_motors=0b0100,
    settings=ArmingSettings(nav_dll_act=1, sys_has_num_dist=1),
)
EARLIER = [
    "Preflight Fail: Motor failure detected",
    "Preflight Fail: heading estimate not stable",
    "Preflight Fail: No offboard signal",
]
BY_RELEASE: dict[PX4ReleaseName, list[str]] = {
    "1.16": [
        *EARLIER,
        "Preflight Fail: no valid data from distance sensor 0",
        "Preflight Fail: No connection to the ground control station",
    ],
    "1.17": [
        *EARLIER,
        "Preflight Fail: No valid distance sensor 0 data",
        "Preflight Fail: No connection to the GCS",
    ],
    "1.18": [
        "Motor failure: Motor 3 undercurrent detected",
        "Preflight Fail: heading estimate invalid",
        "Preflight Fail: No offboard signal",
        "Preflight Fail: No valid distance sensor 0 data",
        "Preflight Fail: No connection to the GCS",
    ],
}


@pytest.mark.parametrize("release", BY_RELEASE)
def test_checks_are_those_of_the_release(release: PX4ReleaseName) -> None:
    failed = failing(FAULTY._replace(release=release))
    others = {text for texts in BY_RELEASE.values() for text in texts}
    assert sorted(c.text for c in failed if c.text in others) == sorted(BY_RELEASE[release])
    names = {definition.number: definition.name for definition in definitions(release)}
    sent = {
        names[event.number]: event
        for event in health_report(FAULTY._replace(release=release)).checks
    }
    assert ("check_motor_undercurrent" in sent) is (release == "1.18")
    assert ("check_modes_offboard_signal_lost" in sent) is (release == "1.18")
    assert ("check_modes_offboard_signal" in sent) is (release != "1.18")
    urgency = Level.WARNING if release == "1.16" else Level.CRITICAL
    assert sent["check_battery_low"].levels & 0xF == urgency


@pytest.mark.parametrize(("release", "armable"), [("1.16", False), ("1.17", False), ("1.18", True)])
def test_modes_without_a_position_arm_with_an_unstable_heading(
    release: PX4ReleaseName, armable: bool
) -> None:
    pilot = Conditions(manual_control_signal_lost=False)
    faulty = READY._replace(compass_agrees=False, conditions=pilot, release=release)
    report = health_report(faulty)
    assert bool(report.can_arm & ModeGroup.STAB) is armable
    assert report.can_arm & ModeGroup.ACRO and not report.can_arm & ModeGroup.POSCTL


@pytest.mark.parametrize("lacks", ["position", "velocity"])
def test_offboard_names_the_missing_estimate_since_1_18(lacks: str) -> None:
    def offboard(release: PX4ReleaseName) -> list[str]:
        checks = failing(READY._replace(mode=Mode.OFFBOARD, offboard_lacks=lacks, release=release))
        return [each.event.name for each in checks if "offboard" in each.event.name]

    assert offboard("1.17") == ["check_modes_offboard_signal"]
    assert offboard("1.18") == [f"check_modes_offboard_no_local_{lacks}"]


def test_a_vehicle_tells_what_has_changed_and_no_more() -> None:
    rig = flight_rig.Rig()
    rig.run(1.9)
    assert rig.ap.take_events() == []
    rig.boot()
    rig.run(2.5)
    told = [read(event)[0] for event in rig.ap.take_events()]
    assert told[0] == "Arming check summary event" and told[-1] == "Health report summary event"
    assert "No offboard signal" in told
    rig.run(5.0)
    assert rig.ap.take_events() == []
    rig.ap.tell_checks()
    rig.run(0.2)
    assert [read(event)[0] for event in rig.ap.take_events()] == told[-7:]
    rig.ap.set_mode(Mode.RETURN)
    assert rig.ap.arm(force=False) != 0
    rig.run(2.5)
    said = [read(event)[0] for event in rig.ap.take_events()]
    assert said[0] == "Arming denied: Resolve system health failures first"
    assert "Mode not suitable for arming" in said
    rig.close()


# --- on the wire


def say(rig: Rig, *texts: str) -> None:
    """Let the autopilot say texts that are events, too; a tick later they are sent."""
    for text in texts:
        event = flight_events.ARMED_BY.event(ArmingReason.COMMAND_EXTERNAL)
        rig.autopilot.messages.append(OperatorText(Severity.INFO, text, event))
        rig.autopilot.events.append(event)
    rig.bench.tick()


def test_events_are_numbered_and_the_number_is_told() -> None:
    rig = Rig()
    say(rig, "one", "two")
    heard = rig.client.received("EVENT", "CURRENT_EVENT_SEQUENCE", "STATUSTEXT")
    assert [m.text for m in heard if m.get_type() == "STATUSTEXT"] == ["one\t", "two\t"]
    first, *sent = [m for m in heard if m.get_type() != "STATUSTEXT"]
    assert (first.get_type(), first.flags) == ("CURRENT_EVENT_SEQUENCE", RESET)
    assert [m.sequence for m in sent] == [FIRST_SEQUENCE, FIRST_SEQUENCE + 1]
    assert sent[0].id == flight_events.ARMED_BY.number and sent[0].log_levels == 0x66
    assert bytes(sent[0].arguments) == bytes([ArmingReason.COMMAND_EXTERNAL]).ljust(40, b"\0")
    assert sent[0].event_time_boot_ms == rig.autopilot.time_us // 1000
    rig.bench.run(6.5)
    told = rig.client.received("CURRENT_EVENT_SEQUENCE")
    assert [(m.sequence, m.flags) for m in told] == [(FIRST_SEQUENCE + 1, 0)] * 2
    assert len(rig.station.received("EVENT")) == 2


def test_numbers_wrap_around_and_old_events_are_gone() -> None:
    rig = Rig()
    for _ in range(KEPT + 5):
        say(rig, "again")
    sent = rig.client.received("EVENT")
    assert [m.sequence for m in sent[8:12]] == [65534, 65535, 0, 1]
    ask = dialect.MAVLink_request_event_message
    rig.client.send(ask(1, 1, 65535, 1))
    rig.bench.tick()
    again = rig.client.received("EVENT", "RESPONSE_EVENT_ERROR")
    assert [m.sequence for m in again] == [65535, 0, 1]
    assert rig.station.received("EVENT")[-1].sequence == sent[-1].sequence
    rig.client.send(ask(1, 1, FIRST_SEQUENCE, FIRST_SEQUENCE))
    rig.bench.tick()
    (gone,) = rig.client.received("EVENT", "RESPONSE_EVENT_ERROR")
    oldest = sent[-KEPT].sequence
    assert (gone.sequence, gone.sequence_oldest_available) == (FIRST_SEQUENCE, oldest)
    assert (gone.target_system, gone.target_component) == (245, 190)
    rig.client.send(ask(1, 1, 1, 0))  # all numbers there are
    rig.bench.tick()
    assert len(rig.client.received("EVENT", "RESPONSE_EVENT_ERROR")) == KEPT


def test_another_boot_begins_anew() -> None:
    rig = Rig()
    say(rig, "before")
    rig.client.received()
    rig.bench.server.attach(rig.autopilot)
    rig.bench.run(3.5)
    (current,) = rig.client.received("EVENT", "CURRENT_EVENT_SEQUENCE")
    assert (current.sequence, current.flags) == (FIRST_SEQUENCE - 1, RESET)
    say(rig, "after")
    assert [m.sequence for m in rig.client.received("EVENT")] == [FIRST_SEQUENCE]


def test_a_pilot_who_is_heard_no_more_is_told_by_events_alone() -> None:
    rig = flight_rig.Rig()
    rig.boot()
    rig.ap.take_events()

    def told() -> list[str]:
        words = [read(event)[0] for event in rig.ap.take_events()]
        return [each for each in words if each.startswith("Manual control")]

    def sticks() -> None:
        now_us = round(rig.time_s * US_PER_S)
        rig.ap.manual_control(Sticks(0.0, 0.0, 0.0, 0.0), Source.JOYSTICK, now_us)

    rig.run(0.5, sticks)
    assert told() == []  # the first is no news
    rig.run(2.0)
    assert told() == ["Manual control lost"]
    rig.run(0.5, sticks)
    (regained,) = told()
    assert re.fullmatch(r"Manual control regained after [12]\.\d+ s", regained)
    rig.close()


def test_a_sensor_that_falls_silent_is_an_event() -> None:
    found = []
    for kind in (ACCEL, GYRO, MAG, BARO, GPS):
        times_us = np.zeros(3, np.int64)  # it has measured once, at 0
        message = SensorWatch(kind, times_us).judge(2 * US_PER_S, times_us.tolist(), flying=True)
        assert message is not None and message.text == f"{kind.name} #0 failed: TIMEOUT!"
        found.append(None if message.event is None else read(message.event)[0])
    assert found == [
        "Accelerometer sensor #0 failure: Timeout",
        "Gyroscope sensor #0 failure: Timeout",
        "Magnetometer sensor #0 failure: Timeout",
        "Baro sensor #0 failure: Timeout",
        None,
    ]


def test_a_mode_that_is_not_available_is_refused_with_an_event() -> None:
    rig = flight_rig.Rig()
    rig.take_off(2.0, settle_s=0.0)
    rig.ap.take_events()
    assert rig.ap.set_mode(Mode.OFFBOARD) is Result.TEMPORARILY_REJECTED
    (refused,) = rig.ap.take_events()
    words, values = read(refused)
    assert words == "Switching to mode 'Offboard' is currently not possible"
    assert values[0] == Mode.OFFBOARD.spec.custom_mode
    rig.close()


def command(number: int, *given: float) -> Any:
    return dialect.MAVLink_command_long_message(1, 1, number, 0, *given, *[0.0] * (7 - len(given)))


def local(frame: int, mask: int) -> Any:
    return dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, mask, *[1.0] * 11)


def globe(frame: int, mask: int) -> Any:
    return dialect.MAVLink_set_position_target_global_int_message(
        0, 1, 1, frame, mask, *(1, 1), *[1.0] * 9
    )


def target(frame: int) -> Any:
    return dialect.MAVLink_landing_target_message(
        0, 0, frame, *[0.0] * 8, [1.0, 0.0, 0.0, 0.0], 2, position_valid=1
    )


@pytest.mark.parametrize(
    ("refused", "text", "words"),
    [
        (
            command(400, 2.5),
            "Unsupported ARM_DISARM param: 2.500",
            "Unsupported ARM_DISARM param: 2.5",
        ),
        (command(2600), None, "Control high latency failed! Telemetry unavailable"),
        (command(176, 1, 4, 99), None, "Unsupported auto mode"),
        (
            command(176, 1, 4, 13),
            "Switching to External 3 is currently not available",
            "Switching to mode 'External 3' is currently not possible",
        ),
        (
            local(9, 0),
            "SET_POSITION_TARGET_LOCAL_NED coordinate frame 9 unsupported",
            "SET_POSITION_TARGET_LOCAL_NED: coordinate frame 9 unsupported",
        ),
        (
            local(1, 0xFFF),
            "SET_POSITION_TARGET_LOCAL_NED invalid",
            "SET_POSITION_TARGET_LOCAL_NED: invalid, missing position, velocity or acceleration",
        ),
        (
            local(1, 0x200),
            "SET_POSITION_TARGET_LOCAL_NED force not supported",
            "SET_POSITION_TARGET_LOCAL_NED: FORCE is not supported",
        ),
        (globe(1, 0), None, "SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame 1"),
        (
            target(8),
            "Landing target: coordinate frame 8 unsupported",
            "Landing target: unsupported coordinate frame 8",
        ),
        (
            dialect.MAVLink_mission_set_current_message(1, 1, 7),
            "WPM: WP CURR CMD: Not in list",
            "New mission waypoint sequence out of bounds",
        ),
        (
            dialect.MAVLink_mission_request_int_message(1, 1, 0, 0),
            "WPM: REJ. CMD: partner id mismatch",
            "Rejecting mission request command, component or system ID mismatch",
        ),
        (command(241, 0, 0, 0, 1), None, "Calibration: Disabling RC input"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_services_refuse_is_an_event(refused: Any, text: str | None, words: str) -> None:
    """All clients receive an event, and PX4's text for clients without event support."""
    rig = Rig()
    rig.client.send(refused)
    rig.bench.run(0.1)
    heard = [*rig.client.received(), *rig.station.received()]
    said = "".join(m.text for m in heard if m.get_type() == "STATUSTEXT")
    assert said == 2 * f"{text or words}\t"
    (event, same) = [m for m in heard if m.get_type() == "EVENT"]
    assert event.id == same.id
    assert read(MavlinkEvent(event.id, event.log_levels, bytes(event.arguments)))[0] == words


def test_nobody_arms_while_a_radio_is_calibrated() -> None:
    rig = Rig()
    assert rig.command(241, 0, 0, 0, 1)[0] == Result.ACCEPTED
    assert rig.command(400, 1)[0] == Result.TEMPORARILY_REJECTED
    assert rig.command(241, *[0.0] * 7)[0] == Result.ACCEPTED
    assert rig.command(400, 1)[0] == Result.ACCEPTED
    rig.bench.tick()
    told = [m.text for m in rig.station.received() if m.get_type() == "STATUSTEXT"]
    assert told[:3] == [
        "Calibration: Disabling RC input\t",
        "Arming denied: calibrating\t",
        "Calibration: Restoring RC input\t",
    ]


def test_a_station_has_the_checks_told_anew() -> None:
    rig = Rig()
    station = RawClient(rig.bench.gcs)
    station.command(dialect.MAV_CMD_RUN_PREARM_CHECKS)
    rig.bench.tick()
    (ack,) = station.received("COMMAND_ACK")
    assert ack.result == dialect.MAV_RESULT_ACCEPTED
    assert rig.autopilot.commands == ["tell checks"]


# --- with MAVSDK


@pytest.fixture(scope="module")
def flight() -> Iterator[Flown]:
    with flown() as flight:
        yield flight


@pytest.mark.slow
@pytest.mark.xdist_group("flight")
def test_mavsdk_understands_events_and_the_health_report(flight: Flown) -> None:
    events = flight.companion.plugin(Events)
    heard: list[Any] = []
    handle = events.subscribe_events(lambda event, _: heard.append(event))

    def report() -> Any:
        try:
            return events.get_health_and_arming_checks_report()
        except EventsError:
            return None

    wait_for(lambda: report() is not None and report().current_mode_intention.can_arm_or_run, 60.0)
    found = report()
    assert found.current_mode_intention.mode_name == "Hold"
    problems = {problem.message: problem for problem in found.all_problems}
    assert problems["No offboard signal"].log_level is LogLevel.ERROR
    assert problems["No manual control input"].health_component == "remote_control"
    parts = {part.name: part for part in found.health_components}
    assert parts["gps"].is_present and parts["battery"].label == "Battery"
    action = flight.companion.plugin(Action)
    action.arm()
    wait_for(lambda: any(e.event_name == "commander_armed_by" for e in heard))
    assert [e.message for e in heard if e.event_name == "commander_armed_by"] == [
        "Armed by external command"
    ]
    action.disarm()
    with pytest.raises(ActionError):
        action.return_to_launch()
        action.arm()
    denied = "Arming denied: Resolve system health failures first"
    wait_for(lambda: denied in [e.message for e in heard])
    with flight.at(5.0):
        # The mode and the result of its checks are separate messages.
        wait_for(lambda: report().current_mode_intention.mode_name == "RTL")
        wait_for(lambda: not report().current_mode_intention.can_arm_or_run)
    assert "Mode not suitable for arming" in [
        problem.message for problem in report().current_mode_intention.problems
    ]
    nowhere = '{"target_system": 1, "target_component": 1, "seq": 7}'
    direct = flight.companion.plugin(MavlinkDirect)
    direct.send_message(MavlinkMessage("MISSION_SET_CURRENT", 245, 190, 1, 1, nowhere))
    unlisted = "New mission waypoint sequence out of bounds"
    wait_for(lambda: unlisted in [e.message for e in heard])
    events.unsubscribe_events(handle)
