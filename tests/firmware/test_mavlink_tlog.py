"""The log opens with pymavlink's log reader, also when its writer was killed."""

from __future__ import annotations

import base64
import stat
import struct
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as dialect

from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.firmware import BuiltinFlightStack, Firmware
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.mavlink.traffic import TlogWriter
from firmware_sim.pacing import Unpaced
from firmware_sim.simulation import EpisodeSetup
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import BOOT_UNIX_US, CLIENT_IDS, Bench, RawClient
from tests.support.memory_hub import MemoryHub


def read(path: Path) -> list[Any]:
    log = mavutil.mavlogfile(str(path))
    messages = []
    while (message := log.recv_match()) is not None:
        messages.append(message)
    log.close()
    return messages


def frame(sequence: int) -> bytes:
    packed: bytes = dialect.MAVLink_ping_message(1, sequence, 0, 0).pack(
        dialect.MAVLink(None, 9, 9)
    )
    return packed


def test_both_directions_of_the_onboard_link_with_their_times(tmp_path: Path) -> None:
    bench = Bench()
    client, station = RawClient(bench.memory), RawClient(bench.gcs)
    bench.run(0.5)
    path = tmp_path / "flight-001.tlog"
    bench.memory.take()
    with closing(TlogWriter(path, BOOT_UNIX_US)) as tlog:
        bench.server.log_to(tlog)
        client.send(dialect.MAVLink_ping_message(1, 77, 0, 0))
        station.send(dialect.MAVLink_ping_message(1, 99, 1, 1))
        bench.run(2.0)
        bench.server.log_to(None)
        assert not path.exists()
    sent = bench.memory.take()
    bench.run(0.1)

    logged = read(path)
    assert not tlog.partial_path.exists()
    own = [m for m in logged if m.get_srcSystem() == 1]
    # mavutil reads a log with its own dialect: it skips what is newer.
    known = [f for f in sent if int.from_bytes(f[7:10], "little") in mavutil.mavlink.mavlink_map]
    assert [bytes(m.get_msgbuf()) for m in own] == known
    (other,) = [m for m in logged if m.get_srcSystem() == 245]
    assert (other.get_type(), other.seq) == ("PING", 77)
    assert not [m for m in logged if m.get_type() == "PING" and m.seq == 99]
    for message in own:
        if message.get_type() == "ATTITUDE":
            expected_s = BOOT_UNIX_US / 1e6 + message.time_boot_ms / 1e3
            assert message._timestamp == pytest.approx(expected_s, abs=4e-6)


def test_every_other_client_that_speaks_has_a_log_beside_it(tmp_path: Path) -> None:
    hub, ground, autopilot = MemoryHub(), MemoryHub(), KinematicAutopilot()
    server = MavlinkServer(
        [onboard_link(hub), gcs_link(ground)], autopilot, boot_unix_us=BOOT_UNIX_US
    )

    def run(ticks: int) -> None:
        for _ in range(ticks):
            server.receive(autopilot.time_us)
            autopilot.step()
            server.send(autopilot.time_us)

    run(50)
    with closing(TlogWriter(tmp_path / "flight-001.tlog", BOOT_UNIX_US)) as tlog:
        server.log_to(tlog)
        run(10)
        station, second, third = ground.client(None), hub.client(7), ground.client(8)
        for number, client in enumerate((station, second, third)):
            client.endpoint.take()
            client.send(dialect.MAVLink_ping_message(1, number, 1, 1))
        run(50)
        server.log_to(None)
    run(50)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "flight-001.tlog",
        "flight-001.gcs.tlog",
        "flight-001.gcs-2.tlog",
        "flight-001.onboard-2.tlog",
    }
    said = {
        name: [m.seq for m in read(tmp_path / name) if m.get_srcSystem() == 245] for name in names
    }
    assert said == {
        "flight-001.tlog": [],
        "flight-001.gcs.tlog": [0],
        "flight-001.onboard-2.tlog": [1],
        "flight-001.gcs-2.tlog": [2],
    }
    heard = [m for m in read(tmp_path / "flight-001.gcs.tlog") if m.get_type() == "ATTITUDE"]
    assert len(heard) == 10  # both directions


@pytest.mark.parametrize("link", ["onboard", "gcs"])
def test_a_signing_key_is_in_no_file_of_a_run(link: str, tmp_path: Path) -> None:
    key, stamp = bytes(range(7, 39)), 123_456_789
    ends = {"onboard": MemoryEndpoint(), "gcs": MemoryEndpoint()}
    links = [onboard_link(ends["onboard"]), gcs_link(ends["gcs"])]
    server = MavlinkServer(links, boot_unix_us=BOOT_UNIX_US)
    firmware = Firmware(BuiltinFlightStack(server), None, Unpaced(), recording=False)
    client, setup = RawClient(ends[link]), dialect.MAVLink_setup_signing_message

    def run(ticks: int) -> None:
        for _ in range(ticks):
            firmware.step()

    with closing(firmware):
        setup_of_flight = EpisodeSetup(load_vehicle("quad"), None, 1)
        firmware.load(setup_of_flight, tmp_path / "flight-001.tlog", BOOT_UNIX_US)
        run(20)
        client.mav.seq = 41
        client.send(setup(1, 1, list(key), stamp))
        run(20)
        # A second key in a signed frame, then a frame for another vehicle.
        client.mav.signing.secret_key, client.mav.signing.sign_outgoing = key, True
        client.mav.signing.timestamp = (BOOT_UNIX_US - 1_420_070_400_000_000) // 10 + 10_000
        client.send(setup(1, 1, list(key[::-1]), stamp + 1))
        run(20)
        client.mav.signing.secret_key = key[::-1]
        client.mav.signing.timestamp += 1_000
        client.send(setup(9, 1, list(key), 0))
        run(20)
        assert server._signing.key == key[::-1]
    files = sorted(tmp_path.rglob("*"))
    other = [] if link == "onboard" else ["flight-001.gcs.tlog"]
    assert [path.name for path in files] == [*other, "flight-001.tlog", "flight-001.ulg"]
    for path in files:
        data = path.read_bytes()
        assert data
        for secret in (key, key[::-1]):
            hexadecimal, text = secret.hex().encode(), base64.b64encode(secret)
            for form in (secret, hexadecimal, hexadecimal.upper(), text, secret[:8], secret[-8:]):
                assert form not in data
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    # mavlogfile checks the CRC. Sender, sequence number, target and time stamp are unchanged.
    found = [m for m in read(files[0]) if m.get_type() == "SETUP_SIGNING"]
    assert [(m.get_srcSystem(), m.get_srcComponent(), m.get_seq()) for m in found] == [
        (*CLIENT_IDS, sequence) for sequence in (41, 42, 43)
    ]
    logged = [(m.target_system, m.initial_timestamp) for m in found]
    assert logged == [(1, stamp), (1, stamp + 1), (9, 0)]
    assert not any(any(m.secret_key) or m.get_signed() for m in found)


def test_all_other_frames_are_logged_as_they_are(tmp_path: Path) -> None:
    mav, path = dialect.MAVLink(None, 9, 9), tmp_path / "a.tlog"
    mav.signing.secret_key, mav.signing.sign_outgoing = bytes(range(32)), True
    signed = [dialect.MAVLink_ping_message(1, n, 0, 0).pack(mav) for n in range(3)]
    # The payload of this MAVLink 1 frame has the bytes of the id of SETUP_SIGNING at its place.
    old = dialect.MAVLink(None, 9, 9)
    first = dialect.MAVLink_ping_message(0x100_00, 5, 0, 0).pack(old, force_mavlink1=True)
    assert first[7:10] == b"\0\1\0"
    frames = [frame(1), *signed, first]
    with closing(TlogWriter(path, BOOT_UNIX_US)) as tlog:
        tlog.write(4_000, *frames)
        tlog.write(8_000, frame(2))
    stamps = [struct.pack(">Q", BOOT_UNIX_US + time_us & ~3) for time_us in (4_000, 8_000)]
    whole = b"".join(stamps[0] + each for each in frames) + stamps[1] + frame(2)
    assert path.read_bytes() == whole


def test_a_log_over_a_readable_leftover_is_private(tmp_path: Path) -> None:
    (tmp_path / "a.tlog.part").touch(mode=0o644)
    with closing(TlogWriter(tmp_path / "a.tlog", BOOT_UNIX_US)) as tlog:
        assert stat.S_IMODE(tlog.partial_path.stat().st_mode) == 0o600


def test_unknown_link() -> None:
    with pytest.raises(ValueError, match="unpack"):
        Bench().server.log_to(None, link="nowhere")


def test_a_killed_writer_leaves_a_readable_part(tmp_path: Path) -> None:
    path = tmp_path / "killed.tlog"
    script = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from firmware_sim.mavlink.traffic import TlogWriter\n"
        "tlog = TlogWriter(Path(sys.argv[1]), 1_700_000_000_000_000)\n"
        "frame = bytes.fromhex(sys.argv[2])\n"
        "for i in range(5_000):\n"
        "    tlog.write(i * 4_000, frame)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(path), frame(3).hex()], check=False)
    assert done.returncode == -9
    assert not path.exists()
    messages = read(tmp_path / "killed.tlog.part")
    assert {m.get_type() for m in messages} == {"PING"}
    assert 5_000 - 251 <= len(messages) <= 5_000  # at most one second (250 ticks) is missing


def test_a_record_cut_in_the_middle_costs_only_itself(tmp_path: Path) -> None:
    path = tmp_path / "cut.tlog"
    with closing(TlogWriter(path, BOOT_UNIX_US)) as tlog:
        for i in range(10):
            tlog.write(i * 4_000, frame(i))
    path.write_bytes(path.read_bytes()[:-5])
    assert [m.seq for m in read(path) if m.get_type() == "PING"] == list(range(9))


def test_closing_twice_and_overwriting(tmp_path: Path) -> None:
    path = tmp_path / "a.tlog"
    for sequence in (1, 2):
        tlog = TlogWriter(path, BOOT_UNIX_US + 3)  # MAVProxy's link bits stay zero
        tlog.write(0, frame(sequence))
        tlog.close()
        tlog.close()
    (message,) = read(path)
    assert (message.seq, message._link) == (2, 0)
