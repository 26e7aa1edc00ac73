"""Messages that took effect on the vehicle, by sender; those that only read leave no mark."""

from __future__ import annotations

from typing import Any

import pytest

from airl_mav.flight.judge import Effect
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.mavlink import traffic
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.services import table
from firmware_sim.mavlink.traffic import READING, READING_COMMANDS, READING_FILES
from tests.firmware.test_mavlink_clients import Field
from tests.support.foreign_messages import FOREIGN, ftp
from tests.support.mavlink_clients import RawClient

COMPANION, FOREIGNER, STATION = (1, 195), (77, 1), (255, 190)
RATE = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
ATTITUDE = dialect.MAVLINK_MSG_ID_ATTITUDE


@pytest.fixture
def field() -> Field:
    field = Field()
    field.autopilot.parameters = Parameters()
    field.server.attach(field.autopilot)
    field.run(0.2)
    return field


def heartbeat(kind: int) -> Any:
    return dialect.MAVLink_heartbeat_message(kind, 8, 0, 0, 0, 3)


def parameter(name: bytes, value: float) -> Any:
    return dialect.MAVLink_param_set_message(1, 1, name, value, dialect.MAV_PARAM_TYPE_REAL32)


def rows(field: Field) -> list[tuple[str, str, int, int, str, int]]:
    return [
        (e.link, e.peer, e.system, e.component, e.message, e.count) for e in field.server.effects()
    ]


@pytest.mark.parametrize("name", FOREIGN)
def test_what_takes_effect_is_recorded_with_its_sender(field: Field, name: str) -> None:
    began_us = field.autopilot.time_us
    client = field.hub.client(5, FOREIGNER)
    for kind in (dialect.MAV_TYPE_GCS, dialect.MAV_TYPE_ONBOARD_CONTROLLER):
        for message in FOREIGN[name]:
            client.send(message)
            field.tick()
        # A later or earlier announcement does not clear the sender.
        client.send(heartbeat(kind))
        field.tick()
    (effect,) = [e for e in field.server.effects() if e.message == name]
    assert (effect.link, effect.peer) == ("gcs", "127.0.0.1:5")
    assert (effect.system, effect.component, effect.count) == (*FOREIGNER, 2)
    assert 0 <= effect.first_us - began_us <= 20_000
    assert not effect.is_companion


def test_the_tables_of_reading_name_messages_of_services() -> None:
    assert set(table("HANDLERS")) >= READING
    assert set(table("ACTIONS")) >= READING_COMMANDS


@pytest.mark.parametrize("number", sorted(READING_COMMANDS))
def test_a_command_that_reads_leaves_no_mark(field: Field, number: int) -> None:
    field.hub.client(5, STATION).command(number, ATTITUDE)
    field.run(0.1)
    assert rows(field) == []


@pytest.mark.parametrize("opcode", range(16))
def test_only_files_that_are_written_leave_a_mark(field: Field, opcode: int) -> None:
    field.hub.client(5, STATION).send(ftp(opcode, b"/fs/microsd/x"))
    field.run(0.1)
    recorded = [row[4] for row in rows(field)]
    assert recorded == ([] if opcode in READING_FILES else ["FILE_TRANSFER_PROTOCOL"])


def test_an_unknown_command_has_no_effect(field: Field) -> None:
    field.hub.client(5, FOREIGNER).command(31_999)
    field.run(0.1)
    assert rows(field) == []


def test_a_changed_parameter_is_recorded_with_old_and_new_value(field: Field) -> None:
    client = field.hub.client(None, STATION)
    store = field.autopilot.parameters
    store.set("MPC_XY_VEL_MAX", 12.0)
    field.server.attach(field.autopilot)  # a new episode: its values at boot are no changes
    for value in (12.0, 3.0, 2.5):
        client.send(parameter(b"MPC_XY_VEL_MAX", value))
        field.tick()
    client.send(parameter(b"NO_SUCH", 1.0))
    client.send(heartbeat(dialect.MAV_TYPE_GCS))
    field.run(0.1)
    (effect,) = field.server.effects()
    assert (effect.message, effect.old, effect.new) == ("PARAM_SET MPC_XY_VEL_MAX", 12.0, 2.5)
    assert effect.line(effect.first_us) == (
        "gcs, system 255 component 190, PARAM_SET MPC_XY_VEL_MAX from 12 to 2.5"
        " (2 times, first 0.0 s after the reset)"
    )


def test_a_reset_records_every_parameter_that_it_changes(field: Field) -> None:
    default = field.autopilot.parameters["MPC_XY_VEL_MAX"]
    field.autopilot.parameters.set("MPC_XY_VEL_MAX", 3.0)
    field.server.attach(field.autopilot)
    field.hub.client(5, STATION).command(dialect.MAV_CMD_PREFLIGHT_STORAGE, 2)
    field.tick()
    first, second = field.server.effects()
    assert (first.message, first.old) == ("COMMAND_LONG MAV_CMD_PREFLIGHT_STORAGE", None)
    assert (second.message, second.old, second.new) == ("COMMAND_LONG MPC_XY_VEL_MAX", 3.0, default)


def test_an_uploaded_plan_is_recorded_with_old_and_new_size(field: Field) -> None:
    client = field.hub.client(5, STATION)
    for kind, name in enumerate(("mission", "fence", "rally")):
        client.send(dialect.MAVLink_mission_count_message(1, 1, 1, kind))
        field.tick()
        command = (16, 5003, 5100)[kind]
        item = (1, 1, 0, 3, command, 0, 1, 50.0, 0, 0, 0, 473977420, 85455940, 10.0, kind)
        client.send(dialect.MAVLink_mission_item_int_message(*item))
        field.tick()
        *_, effect = field.server.effects()
        assert (effect.message, effect.old, effect.new) == (
            f"MISSION_ITEM_INT items of {name}",
            0,
            1,
        )


def test_the_companion_is_known_by_address_and_id(field: Field) -> None:
    endpoint = field.onboard
    for ids in (COMPANION, FOREIGNER, (77, 195)):
        RawClient(endpoint, ids).command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        field.tick()
    field.hub.client(9, COMPANION).command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    field.tick()
    assert [(e.link, e.system, e.is_companion) for e in field.server.effects()] == [
        ("onboard", 1, True),
        ("onboard", 77, False),
        ("onboard", 77, False),
        ("gcs", 1, False),
    ]


def test_a_rate_of_the_companions_link_is_an_effect(field: Field) -> None:
    RawClient(field.onboard, FOREIGNER).command(RATE, ATTITUDE, -1)
    RawClient(field.onboard, COMPANION).command(RATE, ATTITUDE, 20_000)
    field.tick()
    assert [(e.message, e.system, e.is_companion) for e in field.server.effects()] == [
        ("COMMAND_LONG MAV_CMD_SET_MESSAGE_INTERVAL", 77, False),
    ]


def test_invented_system_ids_fill_no_memory(field: Field, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traffic, "MAX_EFFECTS", 5)
    for system in range(20, 50):
        field.hub.client(5, (system, 1)).command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        field.tick()
    *known, last = field.server.effects()
    assert [e.system for e in known] == [20, 21, 22, 23, 24]
    assert (last.link, last.message, last.count) == ("others", "further messages", 25)
    assert not last.is_companion


def test_a_new_episode_begins_without_effects(field: Field) -> None:
    field.hub.client(5, FOREIGNER).command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    field.tick()
    assert len(field.server.effects()) == 1
    field.server.attach(field.autopilot)
    assert field.server.effects() == ()


def test_an_effect_on_one_line() -> None:
    effect = Effect("onboard", "10.0.0.7:5000", 77, 1, "ODOMETRY", 1, 12_340_000, False)
    assert effect.line(10_000_000) == (
        "onboard 10.0.0.7:5000, system 77 component 1, ODOMETRY (once, first 2.3 s after the reset)"
    )
