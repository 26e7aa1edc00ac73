"""MAVLink 2 signing against pymavlink's, both ways; replays, forgeries, downgrades; key files."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.clock import SimClock
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.signing import (
    EPOCH_UNIX_US,
    LATE,
    MAX_STREAMS,
    SAVE_EVERY_US,
    SIGNATURE_BYTES,
    UNIT_US,
    Signing,
    StoredSigning,
    camera_key,
    frames_of,
    read_key,
    write_key,
)
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from airl_mav.scenario.stand_alone import (
    StandAloneCompanion,
    StandAloneVehicle,
    check_companion,
    check_vehicle,
)

KEY = bytes(range(32))
OTHER = bytes(range(1, 33))
NOW_US = EPOCH_UNIX_US + 300_000_000_000_000
NOW = (NOW_US - EPOCH_UNIX_US) // UNIT_US


def peer(key: bytes = KEY, link_id: int = 5, timestamp: int = NOW) -> Any:
    mav = dialect.MAVLink(None, 245, 190)
    mav.signing.secret_key = key
    mav.signing.link_id = link_id
    mav.signing.timestamp = timestamp
    mav.signing.sign_outgoing = True
    return mav


def signing(key: bytes | None = KEY) -> Signing:
    return Signing(lambda: NOW_US, key)


def messages() -> list[Any]:
    return [
        dialect.MAVLink_ping_message(1, 2, 3, 4),
        dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3),
        dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0),
        dialect.MAVLink_statustext_message(6, b"x" * 50),
        dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, list(range(251))),
    ]


def test_pymavlink_accepts_our_signatures() -> None:
    theirs, ours = peer(), signing()
    plain = dialect.MAVLink(None, 1, 1)
    for message in messages():
        frame = ours.sign(message.pack(plain), 0)
        decoded = theirs.decode(bytearray(frame))
        assert decoded.get_signed()
        assert decoded.to_dict() == message.to_dict()
    assert theirs.signing.goodsig_count == len(messages())
    assert ours.sign(frame, 0) == frame  # Once is enough.


def test_signatures_of_pymavlink_are_accepted() -> None:
    theirs, ours = peer(), signing()
    for message in messages():
        assert ours.accepts(message.pack(theirs))
    assert ours.refused == 0


def test_every_bit_of_a_signed_frame_counts() -> None:
    frame = messages()[0].pack(peer())
    for position in range(len(frame) * 8):
        if position // 8 == 0:
            continue  # A frame starts with its marker.
        forged = bytearray(frame)
        forged[position // 8] ^= 1 << position % 8
        assert not signing().accepts(bytes(forged)), position


def test_nothing_is_taken_twice_or_out_of_order() -> None:
    theirs, ours = peer(), signing()
    first, second = (m.pack(theirs) for m in messages()[:2])
    assert ours.accepts(second)
    assert not ours.accepts(second)
    assert not ours.accepts(first)
    # Each link id is a separate stream; the signature covers it.
    assert ours.accepts(messages()[0].pack(peer(link_id=6)))
    assert ours.refused == 2


def test_a_forged_time_stamp_locks_nobody_out() -> None:
    ours = signing()
    assert not ours.accepts(messages()[0].pack(peer(OTHER, timestamp=NOW * 2)))
    assert ours.accepts(messages()[0].pack(peer()))


@pytest.mark.parametrize(("behind", "accepted"), [(LATE - 10, True), (LATE + 10, False)])
def test_a_new_sender_may_lag_by_a_minute(behind: int, accepted: bool) -> None:
    frame = messages()[0].pack(peer(timestamp=NOW - behind))
    assert signing().accepts(frame) is accepted


def test_unsigned_frames_are_refused_but_for_what_radios_send() -> None:
    ours, plain = signing(), dialect.MAVLink(None, 245, 190)
    passed = {
        kind.msgname
        for kind in dialect.mavlink_map.values()
        if ours.accepts(_empty(kind).pack(plain))
        or (kind.id < 256 and ours.accepts(_empty(kind).pack(plain, force_mavlink1=True)))
    }
    assert passed == {"HEARTBEAT", "RADIO_STATUS", "ADSB_VEHICLE", "COLLISION"}
    assert signing(None).accepts(messages()[0].pack(plain))


def test_after_one_signed_frame_no_unsigned_one_counts() -> None:
    """An unsigned HEARTBEAT of any system is rejected, also of a system without a key."""
    ours = signing()
    beats = [
        messages()[1].pack(dialect.MAVLink(None, system, component), force_mavlink1=old)
        for system, component in ((1, 1), (245, 190), (7, 1))
        for old in (False, True)
    ]
    assert all(map(ours.accepts, beats))
    assert not any(ours.accepts(beat, unsigned=False) for beat in beats)
    assert not ours.accepts(messages()[0].pack(peer(OTHER)))
    assert all(map(ours.accepts, beats))
    assert ours.accepts(messages()[0].pack(peer()))
    assert not any(map(ours.accepts, beats))
    ours.change(OTHER)
    assert all(map(ours.accepts, beats))


def test_a_new_key_has_no_frames_of_an_earlier_program() -> None:
    ours = signing()
    ours.floor = NOW + 2
    assert not ours.accepts(messages()[0].pack(peer()))
    ours.change(OTHER)
    assert ours.accepts(messages()[0].pack(peer(OTHER)))


def test_own_frames_do_not_come_back() -> None:
    ours = signing()
    frame = ours.sign(messages()[0].pack(dialect.MAVLink(None, 1, 1)), 0)
    assert signing().accepts(frame)
    assert not ours.accepts(frame)


def _empty(kind: Any) -> Any:
    values = {
        name: b"" if of == "char" else [0] * n if n else 0
        for name, of, n in zip(
            kind.fieldnames,
            kind.fieldtypes,
            [kind.array_lengths[kind.ordered_fieldnames.index(n)] for n in kind.fieldnames],
            strict=True,
        )
    }
    return kind(*values.values())


def test_time_stamps_only_rise_and_follow_the_newest_heard() -> None:
    ours, plain = signing(), dialect.MAVLink(None, 1, 1)
    frames = [ours.sign(messages()[0].pack(plain), 0) for _ in range(3)]
    stamps = [int.from_bytes(frame[-12:-6], "little") for frame in frames]
    assert stamps == [NOW, NOW + 1, NOW + 2]
    assert ours.accepts(messages()[0].pack(peer(timestamp=NOW + 500)))
    frame = ours.sign(messages()[0].pack(plain), 0)
    assert int.from_bytes(frame[-12:-6], "little") == NOW + 501


def test_the_last_time_stamp_breaks_nothing() -> None:
    ours, plain = signing(), dialect.MAVLink(None, 1, 1)
    for stamp in (2**48 - 2, 2**48 - 1, 2**64 - 1):
        ours.change(KEY, stamp)
        frames = [ours.sign(messages()[0].pack(plain), 0) for _ in range(4)]
        assert frames[-1][-12:-6] == b"\xff" * 6


def test_senders_are_bounded() -> None:
    ours = signing()
    accepted = 0
    for system in range(1, 256):
        for link_id in (0, 1):
            theirs = peer(link_id=link_id)
            theirs.srcSystem = system
            accepted += ours.accepts(messages()[0].pack(theirs))
    assert accepted == MAX_STREAMS


def test_frames_of_a_datagram() -> None:
    plain, theirs = dialect.MAVLink(None, 1, 1), peer()
    frames = [m.pack(plain) for m in messages()] + [m.pack(theirs) for m in messages()]
    assert list(frames_of(b"".join(frames))) == frames
    assert list(frames_of(b"noise" + frames[0] + frames[1][:-1])) == frames[:1]
    assert len(frames[5]) == len(frames[0]) + SIGNATURE_BYTES


# --- files


def test_a_key_file_is_for_its_owner_alone(tmp_path: Path) -> None:
    path = tmp_path / "key"
    write_key(path, KEY)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_key(path) == KEY
    path.chmod(0o640)
    with pytest.raises(UsageError, match="mode 0640: others may read it; chmod 600 it"):
        read_key(path)


@pytest.mark.parametrize("text", ["", "12", "zz" * 32, "00" * 32, "11" * 33, "\xff" * 64])
def test_an_unusable_key_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "key"
    path.touch(mode=0o600)
    path.write_text(text)
    with pytest.raises(UsageError, match="must be 64 hexadecimal digits"):
        read_key(path)


def test_a_missing_key_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"nothing.*cannot be read: No such file"):
        read_key(tmp_path / "nothing")


def test_key_and_newest_time_stamp_outlive_the_program(tmp_path: Path) -> None:
    path, clock = tmp_path / "key", SimClock()
    write_key(path, KEY)
    stored = StoredSigning(path, clock)
    stored.signing.accepts(messages()[0].pack(peer(timestamp=NOW * 3)))
    stamp = tmp_path / "key.timestamp"
    stored.save_due()
    assert not stamp.exists()
    clock.advance(SAVE_EVERY_US)
    stored.save_due()
    assert int(stamp.read_text()) == NOW * 3
    # Messages from long before the stored timestamp are too old for a new program, too.
    late = StoredSigning(path, clock)
    assert late.signing.timestamp == NOW * 3
    assert not late.signing.accepts(messages()[0].pack(peer(timestamp=NOW * 2)))
    # The earlier program may have accepted frames of the last minute.
    assert not late.signing.accepts(messages()[0].pack(peer(timestamp=NOW * 3)))
    assert late.signing.accepts(messages()[0].pack(peer(timestamp=NOW * 3 + 1)))
    stored.signing.change(OTHER, 7)
    assert read_key(path) == OTHER
    assert StoredSigning(path).signing.timestamp == 7
    stored.signing.change(None)
    assert not path.exists()


def test_a_time_stamp_that_cannot_be_written_ends_nothing(tmp_path: Path) -> None:
    path = tmp_path / "key"
    write_key(path, KEY)
    stored = StoredSigning(path)
    (tmp_path / "key.timestamp").mkdir()  # A folder cannot be replaced by a file.
    stored.save()
    assert stored.signing.key == KEY


# --- the camera's key


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp://127.0.0.1:5600", True),
        ("tcp://127.0.0.9:*", True),
        ("tcp://localhost:5600", True),
        ("tcp://[::1]:5600", True),
        ("ipc:///tmp/camera", True),
        ("realsense", True),
        ("tcp://0.0.0.0:5600", False),
        ("tcp://*:5600", False),
        ("tcp://192.168.1.2:5600", False),
        ("tcp://192.168.1.2:1;127.0.0.1:5600", False),
        ("tcp://127.0.0.1.example.org:5600", False),
        ("tcp://[::]:5600", False),
    ],
)
def test_images_leave_the_machine_encrypted(endpoint: str, local: bool, tmp_path: Path) -> None:
    path = tmp_path / "camera.key"
    write_key(path, KEY)
    if local:
        assert camera_key(None, endpoint, "camera") is None
    else:
        with pytest.raises(FieldError, match=r"unencrypted: give a --camera-key, or --insecure"):
            camera_key(None, endpoint, "camera")
    assert camera_key(None, endpoint, "camera", insecure=True) is None
    if "://" in endpoint:
        assert camera_key(path, endpoint, "camera") == KEY
        path.chmod(0o640)
        with pytest.raises(FieldError, match=r"^camera_key .*mode 0640.*chmod 600"):
            camera_key(path, endpoint, "camera")


@pytest.mark.parametrize("level", ["gym", "lockstep"])
def test_a_camera_without_a_socket_refuses_the_key(level: str) -> None:
    with pytest.raises(FieldError, match=r"camera_key .*accepted: at level sitl"):
        resolve(Scenario.model_validate({"camera_key": Path("key"), "level": level}))


# --- settings without signing


@pytest.mark.parametrize(
    "asked",
    [
        {"level": "gym"},
        {"level": "lockstep"},
        {"firmware": "px4", "real": {"px4_connect": True}},
        {"level": "lockstep", "firmware": "px4", "real": {"px4_connect": True}},
        {"firmware": "ardupilot", "real": {"ardupilot_connect": True}},
    ],
)
def test_a_rehearsal_in_which_nobody_signs_refuses_the_key(asked: dict[str, Any]) -> None:
    with pytest.raises(FieldError, match="accepted: at level sitl, with firmware builtin"):
        resolve(Scenario.model_validate({"signing_key": Path("key"), **asked}))


def test_a_vehicle_that_does_not_sign_refuses_the_key() -> None:
    real = {"firmware": "px4", "real": {"px4_connect": True}}
    with pytest.raises(FieldError, match=r"signing_key .*with firmware builtin"):
        check_vehicle(StandAloneVehicle.model_validate({"signing_key": Path("key"), **real}))


def test_both_ends_of_lockstep_take_the_key() -> None:
    asked = {"signing_key": Path("key"), "lockstep": True}
    check_vehicle(StandAloneVehicle.model_validate(asked))
    check_companion(StandAloneCompanion.model_validate(asked))
