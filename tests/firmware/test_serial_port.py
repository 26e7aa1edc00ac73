"""A serial port over a pseudo-terminal."""

from __future__ import annotations

import os
import time
import tty
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from airl_mav.core.errors import UsageError
from firmware_sim.addons.px4_hitl.bridge import check_line
from firmware_sim.addons.px4_hitl.line import BUFFER_BYTES, SerialLostError, SerialPort
from tests.support.hitl_peer import HitlPeer

PATIENCE_S = 60.0


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[HitlPeer]:
    peer = HitlPeer(tmp_path)
    yield peer
    peer.close()


@pytest.mark.parametrize(
    ("device", "words"),
    [
        ("{}/nothing", ["--serial", "no such device", "present"]),
        ("{}", ["--serial"]),
        ("/dev/null", ["--serial /dev/null", "no serial device"]),
    ],
)
def test_what_cannot_be_opened(tmp_path: Path, device: str, words: list[str]) -> None:
    with pytest.raises(UsageError) as error:
        SerialPort(device.format(tmp_path))
    assert all(word in str(error.value) for word in words), str(error.value)


def test_a_device_that_another_program_has_open(peer: HitlPeer) -> None:
    first = SerialPort(peer.device)
    with pytest.raises(UsageError, match=r"--serial .*another program has it open"):
        SerialPort(peer.device)
    first.close()
    SerialPort(peer.device).close()


@pytest.mark.parametrize("baud", [0, -9600, 10**9])
def test_impossible_baud_rates(peer: HitlPeer, baud: int) -> None:
    with pytest.raises(UsageError, match=f"--baud {baud}"):
        SerialPort(peer.device, baud)


def test_a_line_that_nobody_reads_takes_a_bounded_amount(tmp_path: Path) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    port = SerialPort(os.ttyname(slave))
    sent = b""
    for i in range(10_000):
        chunk = i.to_bytes(4, "big") * 25
        if not port.write(chunk):
            break
        sent += chunk
    assert port.dropped == 1
    received = b""
    os.set_blocking(master, False)
    deadline = time.monotonic() + 10.0
    while len(received) < len(sent) and time.monotonic() < deadline:  # the far end reads again
        with suppress(BlockingIOError):
            received += os.read(master, 65536)
        port.drain()
    assert received == sent  # nothing was lost, nothing torn
    assert port.write(b"more")
    assert len(sent) >= BUFFER_BYTES
    port.close()
    os.close(master)
    os.close(slave)


def test_an_unplugged_device(peer: HitlPeer) -> None:
    port = SerialPort(peer.device)
    peer.unplug()
    deadline = time.monotonic() + PATIENCE_S
    with pytest.raises(SerialLostError, match="ttyBOARD is gone"):
        while time.monotonic() < deadline:
            port.read()
    with pytest.raises(SerialLostError, match="ttyBOARD is gone"):
        port.write(b"anybody?")
    port.close()
    port.close()


def test_lines_too_slow_for_sensors() -> None:
    for baud in (57_600, 115_200, 230_400):
        with pytest.raises(UsageError, match=rf"--baud {baud}: 250 HIL_SENSOR .*accepted"):
            check_line("/dev/ttyUSB0", baud)
    for baud in (460_800, 921_600):
        assert 0 < check_line("/dev/ttyUSB0", baud) < baud / 10
    assert check_line("/dev/ttyACM0", 57_600) == check_line("/dev/pts/3", 921_600)
