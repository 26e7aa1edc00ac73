"""The mission protocol on the wire, with pymavlink's messages and its MAVWPLoader."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink import mavwp
from pymavlink.dialects.v20 import common as dialect

from firmware_sim.autopilot.navigation.plan import MissionType
from tests.support.mavlink_clients import CLIENT_IDS, RawClient, Rig, text_of

HOME = (473_977_430, 85_455_940)
STRANGER = (77, 5)


@pytest.fixture
def rig() -> Rig:
    return Rig()


def item_int(seq: int, kind: int = 0, **fields: Any) -> Any:
    """Return a waypoint 10 m above home, fields of it replaced."""
    values = {
        "frame": 6, "command": 16, "current": int(seq == 0), "autocontinue": 1,
        "param1": 0.0, "param2": 0.0, "param3": 0.0, "param4": float("nan"),
        "x": HOME[0] + 100 * seq, "y": HOME[1], "z": 10.0, **fields,
    }  # fmt: skip
    return dialect.MAVLink_mission_item_int_message(1, 1, seq, *values.values(), kind)


def as_float(message: Any) -> Any:
    """Return the same item as MISSION_ITEM."""
    names = [n for n in message.fieldnames if n not in ("x", "y", "frame")]
    fields = {name: getattr(message, name) for name in names}
    frame = {5: 0, 6: 3}.get(message.frame, message.frame)
    scale = 1.0 if frame == 2 else 1e-7
    return dialect.MAVLink_mission_item_message(
        **fields, frame=frame, x=message.x * scale, y=message.y * scale
    )


def replies(messages: list[Any]) -> list[Any]:
    return [m for m in messages if m.get_type() != "STATUSTEXT" and "MISSION" in m.get_type()]


def upload(rig: Rig, items: list[Any], kind: int = 0, *, integer: bool = True) -> int:
    """Upload as an obedient client does, and return the result."""
    requests = ("MISSION_REQUEST", "MISSION_REQUEST_INT")
    answers = rig.exchange(dialect.MAVLink_mission_count_message(1, 1, len(items), kind))
    for _ in range(2 * len(items) + 2):
        done = [m for m in answers if m.get_type() == "MISSION_ACK"]
        if done:
            assert (done[0].target_system, done[0].target_component) == CLIENT_IDS
            assert done[0].mission_type == kind
            return int(done[0].type)
        (request,) = [m for m in answers if m.get_type() in requests]
        item = items[request.seq]
        answers = rig.exchange(item if integer else as_float(item))
    raise AssertionError("no MISSION_ACK")


def download(rig: Rig, kind: int = 0, *, integer: bool = True) -> list[Any]:
    answers = rig.exchange(dialect.MAVLink_mission_request_list_message(1, 1, kind))
    (count,) = [m for m in answers if m.get_type() == "MISSION_COUNT"]
    request = (
        dialect.MAVLink_mission_request_int_message
        if integer
        else dialect.MAVLink_mission_request_message
    )
    found = []
    for seq in range(count.count):
        name = "MISSION_ITEM_INT" if integer else "MISSION_ITEM"
        (item,) = [m for m in rig.exchange(request(1, 1, seq, kind)) if m.get_type() == name]
        found.append(item)
    rig.exchange(dialect.MAVLink_mission_ack_message(1, 1, 0, kind))
    return found


MIXED = [
    item_int(0, command=22, z=5.0),
    item_int(1, param1=2.0, param2=1.5, param3=9.0, param4=-90.0),
    item_int(2, frame=2, command=178, param1=1.0, param2=3.0, x=0, y=0, z=0.0),
    item_int(3, command=19, param1=4.0, param2=7.0, param4=30.0),
    item_int(4, frame=2, command=177, param1=1.9, param2=2.0, x=0, y=0, z=0.0),
    item_int(5, frame=5, command=21, z=500.0),
    item_int(6, frame=2, command=20, x=0, y=0, z=0.0, autocontinue=0),
]


@pytest.mark.parametrize("integer", [True, False])
def test_what_is_uploaded_is_downloaded_as_px4_keeps_it(rig: Rig, integer: bool) -> None:
    assert upload(rig, MIXED, integer=integer) == 0
    found = download(rig, integer=integer)
    assert [m.command for m in found] == [22, 16, 178, 19, 177, 21, 20]
    frames = [6, 6, 2, 6, 2, 5, 2] if integer else [3, 3, 2, 3, 2, 0, 2]
    assert [m.frame for m in found] == frames
    assert [m.current for m in found] == [1, 0, 0, 0, 0, 0, 0]
    assert [m.autocontinue for m in found] == [1, 1, 1, 1, 1, 1, 0]
    waypoint, loiter, jump = found[1], found[3], found[4]
    # Parameter 3 of a waypoint is not kept, a heading is turned into 0..360 degrees.
    assert (waypoint.param1, waypoint.param2, waypoint.param3) == (2.0, 1.5, 0.0)
    assert waypoint.param4 == 270.0
    assert (loiter.param1, loiter.param2, loiter.param4) == (4.0, 1.0, 1.0)
    assert (jump.param1, jump.param2) == (1.0, 2.0)
    assert found[5].z == 500.0
    scale = 1 if integer else 1e-7
    tolerance = 0 if integer else 4e-6  # a float32 of degrees
    for sent, got in zip(MIXED, found, strict=True):
        if sent.frame != 2:
            assert abs(got.x - sent.x * scale) <= tolerance


def test_px4_asks_for_floats_first_and_learns(rig: Rig) -> None:
    (request,) = replies(rig.exchange(dialect.MAVLink_mission_count_message(1, 1, 1, 0)))
    assert request.get_type() == "MISSION_REQUEST"
    unsupported = dialect.MAVLink_mission_ack_message(1, 1, dialect.MAV_MISSION_UNSUPPORTED, 0)
    (request,) = replies(rig.exchange(unsupported))
    assert request.get_type() == "MISSION_REQUEST_INT"
    assert request.seq == 0
    rig.exchange(item_int(0))
    # Another client may know floats alone.
    other = RawClient(rig.bench.memory, STRANGER)
    other.send(dialect.MAVLink_mission_count_message(1, 1, 1, 0))
    rig.bench.tick()
    assert [m.get_type() for m in replies(rig.client.received())] == ["MISSION_REQUEST"]


def test_mavwp_of_pymavlink_up_and_down(rig: Rig) -> None:
    loader = mavwp.MAVWPLoader(1, 1)
    for seq, item in enumerate(MIXED):
        loader.add(as_float(item), comment=str(seq))
    assert upload(rig, [loader.wp(i) for i in range(loader.count())], integer=True) == 0
    back = mavwp.MAVWPLoader(1, 1)
    for item in download(rig, integer=False):
        back.add(item)
    assert [back.wp(i).command for i in range(back.count())] == [m.command for m in MIXED]
    assert back.wp(0).x == pytest.approx(47.397743, abs=4e-6)


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_lists_are_separate_and_cleared_one_by_one_or_all(rig: Rig, kind: int) -> None:
    plans = rig.autopilot.plans
    for each, command in ((0, 16), (1, 5003), (2, 5100)):
        assert upload(rig, [item_int(0, each, command=command, param1=30.0)], each) == 0
    assert [len(plans.stored(k).items) for k in MissionType] == [1, 1, 1]
    assert len({plans.stored(k).identity for k in MissionType}) == 3
    (ack,) = replies(rig.exchange(dialect.MAVLink_mission_clear_all_message(1, 0, kind)))[:1]
    assert (ack.type, ack.mission_type) == (0, kind)
    assert [len(plans.stored(k).items) for k in MissionType] == [int(k != kind) for k in range(3)]
    assert download(rig, kind) == []
    rig.exchange(dialect.MAVLink_mission_clear_all_message(1, 190, 255))
    assert [plans.stored(k).identity for k in MissionType] == [0, 0, 0]


def test_a_count_of_zero_clears(rig: Rig) -> None:
    upload(rig, MIXED)
    assert upload(rig, []) == 0
    assert rig.autopilot.plans.mission == ()


@pytest.mark.parametrize(
    ("fields", "result"),
    [
        ({"command": 18}, 3),  # LOITER_TURNS: PX4 has none
        ({"frame": 2, "command": 16}, 3),
        ({"frame": 1}, 2),
        ({"frame": 8}, 2),
        ({"frame": 2, "command": 201, "param1": 3.0}, 6),  # ROI without a place
        ({"command": 201, "param1": 2.0}, 6),
    ],
)
def test_invalid_items_end_the_upload(rig: Rig, fields: dict[str, Any], result: int) -> None:
    upload(rig, MIXED)
    rig.exchange(dialect.MAVLink_mission_count_message(1, 1, 2, 0))
    answers = rig.exchange(item_int(0, **fields))
    assert [m.type for m in answers if m.get_type() == "MISSION_ACK"] == [result]
    assert text_of(answers) == [(2, "IGN MISSION_ITEM: Invalid item")]
    # The stored mission remains, and a new upload may begin.
    assert len(rig.autopilot.plans.mission) == len(MIXED)
    assert upload(rig, MIXED[:2]) == 0


@pytest.mark.parametrize(("x", "y", "result"), [("nan", "8.5", 10), ("47.4", "inf", 11)])
def test_a_place_must_be_numbers(rig: Rig, x: str, y: str, result: int) -> None:
    rig.exchange(dialect.MAVLink_mission_count_message(1, 1, 1, 0))
    item = dialect.MAVLink_mission_item_message(
        1, 1, 0, 3, 16, 1, 1, 0, 0, 0, 0, float(x), float(y), 10, 0
    )
    answers = rig.exchange(item)
    assert [m.type for m in answers if m.get_type() == "MISSION_ACK"] == [result]


@pytest.mark.parametrize("command", [80, 201])
@pytest.mark.parametrize(("region", "result"), [(0.0, 0), (3.0, 0), (1.0, 6), (math.nan, 6)])
def test_a_region_of_interest_must_be_named(
    rig: Rig, command: int, region: float, result: int
) -> None:
    assert upload(rig, [item_int(0, command=command, param1=region)]) == result


@pytest.mark.parametrize(
    ("kind", "fields"), [(0, {"command": 5100}), (0, {"command": 5001}), (1, {"command": 5001})]
)
def test_items_of_another_list_and_too_small_polygons_are_refused(
    rig: Rig, kind: int, fields: dict[str, Any]
) -> None:
    assert upload(rig, [item_int(0, kind, param1=2.0, **fields)], kind) == 1


def test_too_many_items(rig: Rig) -> None:
    for kind, most in ((1, 64), (2, 32), (7, 0)):
        message = dialect.MAVLink_mission_count_message(1, 1, most + 1, kind)
        (ack,) = replies(rig.exchange(message))
        assert (ack.type, ack.mission_type) == (4, kind)


def test_a_lost_item_is_asked_for_again_then_given_up(rig: Rig) -> None:
    rig.exchange(dialect.MAVLink_mission_count_message(1, 1, 2, 0))
    rig.bench.run(1.0)
    again = replies(rig.client.received())
    assert [m.seq for m in again if m.get_type() == "MISSION_REQUEST"] == [0, 0, 0]
    answers = rig.exchange(item_int(0))
    assert [m.seq for m in replies(answers)] == [1]
    rig.bench.run(4.9)
    assert not text_of(rig.client.received())
    rig.bench.run(0.3)
    assert text_of(rig.client.received()) == [(2, "Operation timeout")]
    assert upload(rig, MIXED) == 0


def test_a_second_client_is_turned_away(rig: Rig) -> None:
    other = RawClient(rig.bench.memory, STRANGER)

    def from_other(message: Any) -> list[Any]:
        rig.client.received()
        other.send(message)
        rig.bench.tick()
        return rig.client.received()

    rig.exchange(dialect.MAVLink_mission_count_message(1, 1, 2, 0))
    (ack,) = replies(from_other(dialect.MAVLink_mission_count_message(1, 1, 2, 0)))
    assert (ack.type, ack.target_system, ack.target_component) == (1, *STRANGER)
    answers = from_other(item_int(0))
    assert text_of(answers) == [(2, "REJ. MIS ITEM: partner id mismatch")]
    answers = from_other(dialect.MAVLink_mission_set_current_message(1, 1, 0))
    assert text_of(answers) == [(2, "WPM: IGN WP CURR CMD: Busy")]
    # On another link, too: one upload at a time.
    rig.station.send(dialect.MAVLink_mission_count_message(1, 1, 2, 0))
    rig.bench.tick()
    (ack,) = rig.station.received("MISSION_ACK")
    assert ack.type == 1
    rig.exchange(item_int(0))
    rig.exchange(item_int(1))
    assert len(rig.autopilot.plans.mission) == 2
    rig.exchange(dialect.MAVLink_mission_request_list_message(1, 1, 0))
    answers = from_other(dialect.MAVLink_mission_request_list_message(1, 1, 0))
    assert text_of(answers) == [(6, "Mission download request ignored, already active")]
    answers = from_other(dialect.MAVLink_mission_clear_all_message(1, 1, 0))
    assert text_of(answers) == [(2, "WPM: IGN CLEAR CMD: Busy")]


def test_the_last_item_again_is_acknowledged_again(rig: Rig) -> None:
    assert upload(rig, MIXED) == 0
    (ack,) = replies(rig.exchange(MIXED[-1]))
    assert (ack.get_type(), ack.type) == ("MISSION_ACK", 0)
    answers = rig.exchange(MIXED[0])
    assert text_of(answers) == [(2, "IGN MISSION_ITEM: No transfer")]


def test_a_download_that_is_never_acknowledged_blocks_nothing(rig: Rig) -> None:
    """Dronekit's downloads are never acknowledged."""
    upload(rig, MIXED[:1])
    for follow, answer in (
        (dialect.MAVLink_mission_set_current_message(1, 1, 0), "MISSION_CURRENT"),
        (dialect.MAVLink_mission_count_message(1, 1, 1, 0), "MISSION_REQUEST_INT"),
        (dialect.MAVLink_mission_clear_all_message(1, 1, 0), "MISSION_ACK"),
    ):
        rig.exchange(dialect.MAVLink_mission_request_list_message(1, 1, 0))
        rig.exchange(dialect.MAVLink_mission_request_int_message(1, 1, 0, 0))
        assert answer in {m.get_type() for m in replies(rig.exchange(follow))}
        rig.exchange(MIXED[0])


def test_a_request_out_of_turn_ends_the_download(rig: Rig) -> None:
    upload(rig, MIXED)
    rig.exchange(dialect.MAVLink_mission_request_list_message(1, 1, 0))
    answers = rig.exchange(dialect.MAVLink_mission_request_int_message(1, 1, 3, 0))
    assert [m.type for m in answers if m.get_type() == "MISSION_ACK"] == [1]
    assert text_of(answers) == [(2, "WPM: REJ. CMD: Req. WP was unexpected")]
    assert len(download(rig)) == len(MIXED)


def test_set_current_tells_everybody(rig: Rig) -> None:
    upload(rig, MIXED)
    rig.station.received()
    for seq in (2, 2, 0):
        answers = rig.exchange(dialect.MAVLink_mission_set_current_message(1, 1, seq))
        assert [(m.seq, m.total) for m in replies(answers)] == [(seq, len(MIXED))]
    assert [m.seq for m in rig.station.received("MISSION_CURRENT")][:1] == [2]
    answers = rig.exchange(dialect.MAVLink_mission_set_current_message(1, 1, 7))
    assert text_of(answers) == [(2, "WPM: WP CURR CMD: Not in list")]


def test_the_same_list_again_keeps_the_place(rig: Rig) -> None:
    upload(rig, MIXED)
    rig.exchange(dialect.MAVLink_mission_set_current_message(1, 1, 3))
    upload(rig, MIXED)
    assert rig.autopilot.plans.current == 3
    upload(rig, MIXED[:2])
    assert rig.autopilot.plans.current == 0  # the item that the upload marks


def test_an_item_reached_is_told_and_repeated(rig: Rig) -> None:
    upload(rig, MIXED)
    rig.autopilot.plans.reached = 1
    rig.bench.run(20.0)
    assert [m.seq for m in rig.client.received("MISSION_ITEM_REACHED")] == [1] * 11


@pytest.mark.parametrize(
    "message",
    [
        dialect.MAVLink_mission_write_partial_list_message(1, 1, 0, 1, 0),
        dialect.MAVLink_mission_request_list_message(2, 1, 0),
        dialect.MAVLink_mission_count_message(1, 100, 3, 0),
        dialect.MAVLink_mission_request_int_message(1, 1, 0, 1),
    ],
)
def test_what_px4_passes_over_in_silence(rig: Rig, message: Any) -> None:
    rig.exchange(dialect.MAVLink_mission_request_list_message(1, 1, 0))
    assert replies(rig.exchange(message)) == []


def test_checksum_is_px4s() -> None:
    """CRC-32 without inversions over a packed item, worked out bit by bit."""
    from firmware_sim.addons.missions.items import checksum

    def bitwise(data: bytes, crc: int) -> int:
        for byte in data:
            crc ^= byte
            for _ in range(8):
                crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
        return crc

    pack: Callable[..., bytes] = __import__("struct").pack
    expected, found = 0, 0
    for item in MIXED:
        body = pack(
            "<BHBffffiif", item.frame, item.command, item.autocontinue,
            item.param1, item.param2, item.param3, item.param4, item.x, item.y, item.z,
        )  # fmt: skip
        expected = bitwise(body, expected)
        found = checksum(item, found)
    # Items are compared as they were received.
    assert found == expected != 0
