"""A stand-in for arducopter at the level of the wire: the JSON simulator interface and MAVLink.

As a thread of a test, or as a program that takes arducopter's own options:
`python ardupilot_peer.py --model JSON:127.0.0.1 --sim-port-out 9002 --serial0 udpclient:HOST:PORT`.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from pathlib import Path

from airl_mav.core.constants import US_PER_S
from firmware_sim.mavlink.endpoint import UdpEndpoint
from tests.support.ardupilot_copter import Copter
from tests.support.ardupilot_mavlink import Manners
from tests.support.ardupilot_wire import MAGIC, JsonLink


class Fault:
    """Fault of the peer: die, stall, restart or garbage, with its time (`stall@12.5`)."""

    def __init__(self, words: str = "") -> None:
        self.kind, _, at = words.partition("@")
        self.at_us = int(float(at or 0.0) * US_PER_S)

    def due(self, kind: str, time_us: int) -> bool:
        return self.kind == kind and time_us >= self.at_us


class DiedError(Exception):
    """The process would be gone."""


class ArdupilotPeer:
    """arducopter on a thread, from power-up to `stop`."""

    def __init__(
        self,
        port: int,
        api_ports: list[int] | None = None,
        *,
        rate_hz: int = 500,
        parameters: dict[str, float] | None = None,
        fault: str = "",
        position_s: float = 3.0,
    ) -> None:
        """Take the ports.

        Args:
            port: Destination of servo packets.
            api_ports: Destinations of MAVLink on the serial ports.
            rate_hz: Requested rate.
            parameters: Override the defaults; the frame is X here.
            fault: See `Fault`.
            position_s: Earliest time of GPS use [s].
        """
        self.fault = Fault(fault)
        self.error: BaseException | None = None
        self.link = JsonLink(port, rate_hz)
        self.link.stop = lambda: self._stop.is_set()
        self.copter = Copter({"FRAME_TYPE": 1, **(parameters or {})}, position_s)
        self.manners = Manners(self.copter, [_client(p) for p in api_ports or []])
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="arducopter", daemon=True)

    def __enter__(self) -> ArdupilotPeer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(10.0)
        self.link.close()
        self.manners.close()
        if self.error is not None:
            raise self.error

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def run(self) -> None:
        """Fly until stopped, or dead."""
        pwm = [0] * 4
        while not self._stop.is_set():
            self._go_wrong()
            state = self.link.exchange(pwm)
            if state is None:
                return
            pwm = self.copter.step(state, self.link.time_us)
            self.manners.run()

    def _run(self) -> None:
        try:
            self.run()
        except DiedError:
            pass
        except BaseException as error:  # shown to the test at the end
            self.error = error

    def _go_wrong(self) -> None:
        now_us, link = self.link.time_us, self.link
        fault = self.fault
        if fault.due("die", now_us):
            raise DiedError
        if fault.due("stall", now_us):
            while not self._stop.is_set():
                time.sleep(0.05)
        if fault.due("restart", now_us):
            fault.kind = ""
            again = JsonLink(link.address[1], link.rate_hz)
            again.stop = link.stop
            link.close()
            self.link = again
        if fault.due("garbage", now_us):
            while not self._stop.is_set():
                link.send([0] * 4, magic=MAGIC + 1)
                time.sleep(0.001)


def _client(port: int) -> UdpEndpoint:
    here, there = ("127.0.0.1", 0), ("127.0.0.1", port)
    return UdpEndpoint(here, there, local_option="local", remote_option="remote")


def _defaults(paths: str) -> dict[str, float]:
    """Read files of default parameters: a name, blanks or a comma, a value."""
    values = {}
    for path in filter(None, paths.split(",")):
        for line in Path(path).read_text("ascii").splitlines():
            words = line.split("#")[0].replace(",", " ").split()
            if len(words) >= 2:
                values[words[0]] = float(words[1])
    return values


def main() -> None:
    """Be arducopter, with its own options and a few more."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--model", required=True)
    parser.add_argument("--sim-port-out", type=int, required=True)
    parser.add_argument("--defaults", default="")
    parser.add_argument("--rate", type=int, default=500)
    parser.add_argument("-I", "--instance", type=int, default=0)
    for number in range(3):
        parser.add_argument(f"--serial{number}", default="none")
    for ignored in ("--speedup", "--home"):
        parser.add_argument(ignored)
    parser.add_argument("-w", "--wipe", action="store_true")
    # Not arducopter's:
    parser.add_argument("--fault", default="", help="also: silent; plus, a frame that stays PLUS")
    parser.add_argument("--position-s", type=float, default=3.0)
    options = parser.parse_args()
    if options.fault == "silent":
        time.sleep(3600.0)
    sys.stdout.write("Starting sketch 'ArduCopter'\n")
    sys.stdout.flush()
    serials = (options.serial0, options.serial1, options.serial2)
    frame = {"FRAME_TYPE": 0} if options.fault == "plus" else {}
    peer = ArdupilotPeer(
        options.sim_port_out,
        [int(serial.split(":")[2]) for serial in serials if serial != "none"],
        rate_hz=options.rate,
        # Unlike a test's peer, the program is PLUS unless its defaults say otherwise.
        parameters={"FRAME_TYPE": 0, **_defaults(options.defaults), **frame},
        fault=options.fault,
        position_s=options.position_s,
    )
    try:
        peer.run()
    except DiedError:
        os._exit(1)


if __name__ == "__main__":
    main()
