"""The generated dialect: its content, the official checksums, and its generation."""

from __future__ import annotations

from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common, development

from firmware_sim.mavlink.codec import Decoder, Encoder, dialect, generated

OFFICIAL_CRC_EXTRA = {
    "LINK_NODE_STATUS": 117,
    "MISSION_CURRENT": 28,
    "MISSION_COUNT": 221,
    "MISSION_ACK": 153,
    "COMMAND_CANCEL": 14,
    "SET_ATTITUDE_TARGET": 49,
    "TIMESYNC": 34,
    "SERIAL_CONTROL": 220,
    "ESC_INFO": 251,
    "ESC_STATUS": 10,
    "PROTOCOL_VERSION": 217,
    "FIGURE_EIGHT_EXECUTION_STATUS": 93,
    "TIME_ESTIMATE_TO_TARGET": 232,
    "COMPONENT_INFORMATION": 0,
    "COMPONENT_INFORMATION_BASIC": 50,
    "COMPONENT_METADATA": 182,
    "PLAY_TUNE_V2": 110,
    "EVENT": 160,
    "CURRENT_EVENT_SEQUENCE": 106,
    "REQUEST_EVENT": 33,
    "RESPONSE_EVENT_ERROR": 77,
    "AVAILABLE_MODES": 134,
    "CURRENT_MODE": 193,
    "AVAILABLE_MODES_MONITOR": 30,
}
"""CRC_EXTRA of the definitions at mavlink.io (mavlink/mavlink, July 2026)."""


def test_checksums_are_the_official_ones() -> None:
    made = {
        kind.msgname: kind.crc_extra
        for kind in dialect.mavlink_map.values()
        if kind.msgname in OFFICIAL_CRC_EXTRA
    }
    assert made == OFFICIAL_CRC_EXTRA


def test_nothing_of_pymavlinks_development_set_is_lost_or_altered() -> None:
    for number, theirs in development.mavlink_map.items():
        ours = dialect.mavlink_map[number]
        assert (ours.msgname, ours.crc_extra) == (theirs.msgname, theirs.crc_extra)
        assert ours.fieldnames[: len(theirs.fieldnames)] == theirs.fieldnames
    constants = {n: v for n, v in vars(development).items() if n.startswith("MAV_")}
    constants = {n: v for n, v in constants.items() if not n.endswith("_ENUM_END")}
    assert constants.items() <= vars(dialect).items()


def test_messages_with_more_fields_are_the_same_bytes_while_those_are_zero() -> None:
    ours = Encoder().pack(dialect.MAVLink_timesync_message(5, 7))
    theirs = common.MAVLink_timesync_message(5, 7).pack(common.MAVLink(None, 1, 1))
    assert ours == theirs


def test_a_newer_message_crosses_a_link_whole() -> None:
    sent = dialect.MAVLink_event_message(0, 0, 0x0100_0001, 4_000, 7, 0x66, list(range(1, 41)))
    (received,) = Decoder(datagrams=True).feed(Encoder().pack(sent))
    assert received.to_dict() == sent.to_dict()


def test_the_module_is_generated_once_and_whole(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    made = generated(tmp_path)
    assert list(tmp_path.iterdir()) == [made]
    assert made.read_bytes() == Path(str(dialect.__file__)).read_bytes()
    made.write_text("present")
    assert generated(tmp_path).read_text() == "present"
    assert capfd.readouterr().out == ""  # standard output belongs to the harness
