"""The log opens with pymavlink's log reader, also when its writer was killed."""

from __future__ import annotations

import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as dialect

from firmware_sim.mavlink.px4_links import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.mavlink.traffic import TlogWriter
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import BOOT_UNIX_US, Bench, RawClient
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
