"""HITL board at the far end of a pseudo-terminal, written from PX4's source code.

All bytes pass through the terminal's buffers. The built-in autopilot flies, behind its own MAVLink
server; the rest of the module imitates a board (px4.md, HITL on real boards):

- HEARTBEAT at 1 Hz with the HIL bit, with or without sensors; then the streams of PX4's link;
- HIL_SENSOR and HIL_GPS are used on arrival, without time_usec: the board's clock starts at boot;
- HIL_ACTUATOR_CONTROLS after each computation of the motors, at most 200 a second, flags 0, mode
  with the HIL bit; motors are not forced to zero while disarmed;
- PREFLIGHT_REBOOT_SHUTDOWN is refused while armed, else acknowledged; 0.4 s later it is down: its
  USB vanishes and comes back.
"""

from __future__ import annotations

import math
import os
import select
import threading
import time
import tty
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as dialect
from pymavlink.generator import mavcrc

from airl_mav.core.constants import TICK_US
from airl_mav.core.frames import Geodetic
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.interfaces import BatterySample, GpsFix, SensorSample
from firmware_sim.mavlink.codec import Decoder, Encoder
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from tests.support.flight_rig import quad
from tests.support.px4_frame import Px4Parameters

REBOOT: int = dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
HIL_BIT = 32
ARMED_BIT = 128
IMU, MAG, BARO = 0b111111, 0b111000000, 0b1101000000000
BATTERY = BatterySample(16.0, 10.0, -1.0, 0.7)
"""A board in HITL makes this one up."""
CONTROLS_S = 0.005
PERIOD_S = 0.002
REBOOT_S = 0.4
"""From its answer until it goes down."""
HEARTBEAT_CRC_EXTRA = 50
DISARMED_OUTPUT = 0.05
"""Outputs while disarmed: the stream does not force them to zero."""


class Board:
    """One power-up."""

    def __init__(self, write: Any, hil: bool, parameters: Parameters) -> None:
        self.write = write
        self.hil = hil
        self.time_us = 100_000
        """Its own clock, from its own start."""
        self.lane = MemoryEndpoint()
        self.server = MavlinkServer([onboard_link(self.lane)], boot_unix_us=0)
        self.autopilot = BuiltinAutopilot(parameters)
        self.encoder = Encoder()
        self.decoder = Decoder(datagrams=False)
        self.attached = False
        self.fresh = False
        self.motors: tuple[float, ...] = (0.0,) * 4
        self.armed = False
        self.gps: GpsFix | None = None
        self.rebooting = False
        self._beat_s = 0.0
        self._controls_s = 0.0

    def take(self, message: Any, raw: bytes) -> None:
        name = message.get_type()
        if name == "HIL_GPS":
            self.gps = GpsFix(
                Geodetic(message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3),
                np.array([message.vn, message.ve, message.vd]) * 1e-2,
                message.eph * 1e-2,
                message.epv * 1e-2,
                message.satellites_visible,
                message.fix_type,
            )
        elif name == "HIL_SENSOR":
            self._fly(message)
        elif name == "COMMAND_LONG" and message.command == REBOOT:
            self._reboot(message)
        else:
            self.lane.inbox.append(raw)

    def _fly(self, m: Any) -> None:
        assert m.fields_updated & IMU == IMU
        self.time_us += TICK_US
        sample = SensorSample(
            self.time_us,
            np.array([m.xacc, m.yacc, m.zacc]),
            np.array([m.xgyro, m.ygyro, m.zgyro]),
            m.temperature,
            BATTERY,
            np.array([m.xmag, m.ymag, m.zmag]) if m.fields_updated & MAG == MAG else None,
            m.abs_pressure if m.fields_updated & BARO == BARO else None,
            self.gps,
        )
        self.gps = None
        controls = self.autopilot.step(sample)
        self.motors, self.armed, self.fresh = controls.motors, controls.armed, True
        if not self.attached:
            self.attached = True
            self.server.attach(self.autopilot)
        self._talk()

    def _reboot(self, m: Any) -> None:
        allowed = m.param1 == 1 and not self.armed
        result = dialect.MAV_RESULT_ACCEPTED if allowed else dialect.MAV_RESULT_DENIED
        self.write(
            self.encoder.pack(
                dialect.MAVLink_command_ack_message(
                    REBOOT, result, 0, 0, m.get_srcSystem(), m.get_srcComponent()
                )
            )
        )
        self.rebooting = allowed

    def _talk(self) -> None:
        self.server.receive(self.time_us)
        self.server.send(self.time_us)
        for frame in self.lane.take():
            self.write(self._marked(frame))

    def _marked(self, frame: bytes) -> bytes:
        """Set the HIL bit of a heartbeat."""
        if frame[7:10] != b"\0\0\0" or not self.hil:
            return frame
        marked = bytearray(frame)
        marked[10 + 6] |= HIL_BIT
        covered = bytes(marked[1:-2]) + bytes([HEARTBEAT_CRC_EXTRA])
        return bytes(marked[:-2]) + mavcrc.x25crc(covered).crc.to_bytes(2, "little")

    def idle(self, now_s: float, flags: int | None) -> None:
        """Do what does not wait for anybody; `flags` None = no motor commands."""
        if now_s - self._beat_s >= 1.0 or self._beat_s == 0.0:
            self._beat_s = now_s
            if not self.attached:
                mode = 29 | (HIL_BIT if self.hil else 0)
                beat = dialect.MAVLink_heartbeat_message(2, 12, mode, 50593792, 3, 3)
                self.write(self.encoder.pack(beat))
        if self.fresh and flags is not None and now_s - self._controls_s >= CONTROLS_S:
            self._controls_s, self.fresh = now_s, False
            motors = self.motors if self.armed else (DISARMED_OUTPUT,) * 4
            mode = 1 | HIL_BIT | (ARMED_BIT if self.armed else 0)
            message = dialect.MAVLink_hil_actuator_controls_message(
                self.time_us, [*motors, *(0.0,) * 12], mode, flags
            )
            self.write(self.encoder.pack(message))


class HitlPeer:
    """Board's end of the line, run by a separate thread. Call `close` to stop it."""

    def __init__(self, folder: Path, *, hil: bool = True, down_s: float = 0.2) -> None:
        self.device = str(folder / "ttyBOARD")
        """A link to the terminal of the moment, like those of /dev/serial/by-id."""
        self.received: Counter[str] = Counter()
        """Messages that have come."""
        self.raw: list[bytes] = []
        """Their frames, but for the simulator's."""
        self.sensor_times: list[int] = []
        """time_usec of each HIL_SENSOR."""
        self.boots = 0
        self.error: BaseException | None = None
        # Faults; may be set at any time.
        self.mute = False
        """Says nothing at all."""
        self.garbled = False
        """Says noise: another baud rate."""
        self.noise = b""
        """Bytes before each frame."""
        self.controls = True
        """Sends motor commands."""
        self.flags = 0
        """Flags of HIL_ACTUATOR_CONTROLS."""
        self.refuses = False
        """Does not take commands to reboot."""
        self.parameters: Callable[[], Parameters] = partial(
            Px4Parameters, quad(), outputs="HIL_ACT_FUNC{}"
        )
        """Parameters, used from the next boot."""
        self.vanishes = True
        """Its USB goes with it when it reboots; else it is behind a UART, and only silent."""
        self.down_s = down_s
        """Time from shutdown to boot [s]."""
        self._hil = hil
        self._up_s = math.inf
        """Time of the next boot."""
        self._goes_s = math.inf
        """Time of the next shutdown."""
        self._rng = np.random.default_rng(0)
        self._master = self._slave = -1
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self.plug_in()
        self._thread = threading.Thread(target=self._run, name="board", daemon=True)
        self._thread.start()

    # --- what can happen to it

    def leave_hil(self) -> None:
        with self._lock:
            self._hil = self.board.hil = False

    def reset(self) -> None:
        """Restart immediately, without disconnecting USB."""
        with self._lock:
            self._power_up()

    def unplug(self) -> None:
        with self._lock:
            if self._master >= 0:
                Path(self.device).unlink()
                os.close(self._slave)
                os.close(self._master)
                self._master = self._slave = -1

    def plug_in(self) -> None:
        with self._lock:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            Path(self.device).symlink_to(os.ttyname(self._slave))
            self._power_up()

    def say(self, data: bytes) -> None:
        """Put any bytes on the line."""
        with self._lock:
            self._write(data)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.unplug()
        if self.error is not None:
            raise self.error

    # --- how it works

    def _power_up(self) -> None:
        self.boots += 1
        self._up_s = self._goes_s = math.inf
        self.board = Board(self._write, self._hil, self.parameters())

    def _write(self, data: bytes) -> None:
        if self._master < 0 or self.mute or self._up_s < math.inf:
            return
        data = self._rng.bytes(len(data)) if self.garbled else self.noise + data
        with suppress(BlockingIOError):  # a full line loses bytes, like a UART's
            os.write(self._master, data)

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                with suppress(OSError, ValueError):  # unplugged by the test
                    select.select([self._master], [], [], PERIOD_S)
                with self._lock:
                    self._turn()
                if self._master < 0:
                    time.sleep(PERIOD_S)
        except BaseException as error:  # shown by close()
            self.error = error

    def _turn(self) -> None:
        now_s = time.monotonic()
        if now_s > self._up_s:
            if self._master < 0:
                self.plug_in()
            else:
                self._power_up()
        if self._master < 0:
            return
        board, data = self.board, b""
        with suppress(BlockingIOError):
            data = os.read(self._master, 65536)
        if self._up_s < math.inf:
            return
        for message in board.decoder.feed(data):
            name, raw = message.get_type(), bytes(message.get_msgbuf())
            self.received[name] += 1
            if name == "HIL_SENSOR":
                self.sensor_times.append(message.time_usec)
            elif name != "HIL_GPS":
                self.raw.append(raw)
            if not (self.refuses and name == "COMMAND_LONG" and message.command == REBOOT):
                board.take(message, raw)
        board.idle(now_s, self.flags if self.controls else None)
        if board.rebooting and self._goes_s == math.inf:
            self._goes_s = now_s + REBOOT_S
        if now_s > self._goes_s:
            self._goes_s = math.inf
            if self.vanishes:
                self.unplug()
            self._up_s = now_s + self.down_s
