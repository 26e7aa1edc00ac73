"""Speed of the plant under PX4.

    python benchmarks/bench_px4.py --px4-dir PX4-Autopilot [--instance 7]
    python benchmarks/bench_px4.py

Boots PX4 SITL (without --px4-dir: the tests' stand-in, which flies our own autopilot), takes off
and hovers, first at full speed, then by the wall clock. Prints multiples of real time and the parts
of a tick's time.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import LOOPBACK, US_PER_S
from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.autopilot.autopilot_state import OperatorText
from firmware_sim.autopilot.commander import CommanderState
from firmware_sim.external.launcher import FirmwareProcess, StartCommand
from firmware_sim.external.programs import (
    API_LOCAL_PORT,
    API_PORT,
    SIMULATOR_PORT,
    environment,
    find_px4,
)
from firmware_sim.external.px4_sitl import Px4Bridge, TcpPort
from firmware_sim.mavlink.codec import Decoder, Encoder, dialect
from firmware_sim.mavlink.endpoint import UdpEndpoint
from firmware_sim.pacing import Pacing, Unpaced, WallPacing
from firmware_sim.plant.plant import Plant
from firmware_sim.simulation import EpisodeSetup, Simulation

ROOT = Path(__file__).resolve().parent.parent
HOVER_S = {"unpaced": 30.0, "paced": 10.0}
AIRFRAME = 10016
LIMIT_S = 60.0
"""Longest simulated time to be in the air."""

ARM, TAKEOFF = 400, 22


class Flown:
    """A bridge as a flight controller."""

    internals = body_by = None
    flight = CommanderState()

    def __init__(self, bridge: Px4Bridge) -> None:
        self.on_message: Callable[[OperatorText], None] | None = None
        self.rate_hz, self.step = bridge.rate_hz, bridge.step
        self.use_truth, self.close = bridge.use_truth, bridge.close


class Operator:
    """Arms and takes off over MAVLink."""

    def __init__(self, instance: int) -> None:
        self._link = UdpEndpoint(
            (LOOPBACK, API_PORT + instance),
            (LOOPBACK, API_LOCAL_PORT + instance),
            local_option="--instance",
            remote_option="--instance",
        )
        self._decoder, self._encoder = Decoder(datagrams=True), Encoder(245, 190)
        self._system, self._ready, self._asked_us = 0, False, 0
        self._on_ground, self.airborne = True, False

    def look(self, now_us: int, *, armed: bool) -> None:
        """Handle received messages, and send the next command once a second."""
        for chunk in self._link.receive():
            if not self.airborne:
                for message in self._decoder.feed(chunk):
                    self._take(message)
        if now_us - self._asked_us < US_PER_S:
            return
        self._asked_us = now_us
        self._link.send(self._encoder.pack(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)))
        # A repeated take-off command in the air restarts the climb, which then never ends.
        if self._ready and self._on_ground:
            number, first = (TAKEOFF, float("nan")) if armed else (ARM, 1.0)
            rest = [float("nan")] * 6
            command = dialect.MAVLink_command_long_message(self._system, 1, number, 0, first, *rest)
            self._link.send(self._encoder.pack(command))

    def _take(self, message: Any) -> None:
        if message.get_type() == "HEARTBEAT":
            self._system = message.get_srcSystem()
            self._ready = message.system_status in (3, 4)
        elif message.get_type() == "EXTENDED_SYS_STATE":
            self._on_ground = message.landed_state == dialect.MAV_LANDED_STATE_ON_GROUND
            self.airborne = message.landed_state == dialect.MAV_LANDED_STATE_IN_AIR

    def close(self) -> None:
        """Close the link."""
        self._link.close()


class Stopwatch:
    """Wall time spent in some methods."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def watch(self, part: str, owner: type, name: str) -> None:
        call: Callable[..., Any] = getattr(owner, name)
        self.seconds[part] = 0.0

        def timed(*arguments: Any, **named: Any) -> Any:
            start = time.perf_counter()
            try:
                return call(*arguments, **named)
            finally:
                self.seconds[part] += time.perf_counter() - start

        setattr(owner, name, timed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--px4-dir", type=Path, help="PX4's build, source tree or package")
    parser.add_argument("--instance", type=int, default=7, help="moves all ports")
    options = parser.parse_args()
    watch = Stopwatch()
    watch.watch("plant and sensors", Plant, "step")
    watch.watch("bridge", Px4Bridge, "step")
    watch.watch("waiting for PX4", TcpPort, "receive")
    # The scheduler may run PX4 right away, before it returns.
    watch.watch("sending", TcpPort, "send")
    table = Table("pacing", "x real time", "tick [µs]", "plant", "bridge", "sending", "waiting")
    for mode, pacing in (("unpaced", Unpaced()), ("paced", WallPacing(1.0))):
        ratio, ticks, spent = flight(options, mode, pacing, watch)
        per_tick = {part: seconds / ticks * US_PER_S for part, seconds in spent.items()}
        sending, waiting = per_tick["sending"], per_tick["waiting for PX4"]
        parts = (per_tick["plant and sensors"], per_tick["bridge"] - sending - waiting)
        tick = f"{4000 / ratio:.0f}"
        cells = [f"{value:.0f}" for value in (*parts, sending, waiting)]
        table.add_row(mode, f"{ratio:.2f}", tick, *cells)
    Console().print(table)


def flight(
    options: argparse.Namespace, mode: str, pacing: Pacing, watch: Stopwatch
) -> tuple[float, int, dict[str, float]]:
    """Return the multiple of real time, the number of ticks, wall seconds by part."""
    instance: int = options.instance
    vehicle = load_vehicle("quad")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bridge, operator = Px4Bridge(SIMULATOR_PORT + instance), Operator(instance)
        if options.px4_dir is not None:
            start = find_px4(options.px4_dir).start(instance, AIRFRAME, folder)
        else:
            peer = [sys.executable, str(ROOT / "tests/support/px4_peer.py"), "-i", str(instance)]
            start = StartCommand(peer, {**environment(AIRFRAME), "PYTHONPATH": str(ROOT)})
        if mode == "unpaced":
            start = replace(start, environment={**start.environment, "PX4_SIM_SPEED_FACTOR": "10"})
        child = FirmwareProcess("PX4", start, folder, folder / "px4.txt")
        try:
            bridge.wait_connected(60.0, child.check)
            setup = EpisodeSetup(vehicle, None, 1)
            simulation = Simulation(setup, start_us=4000, clock=SimClock(), autopilot=Flown(bridge))

            def tick() -> None:
                pacing.wait(simulation.time_us, (), lambda _now_us: None)
                simulation.tick()
                operator.look(simulation.time_us, armed=bridge.armed)

            while not operator.airborne:
                tick()
                if simulation.time_us > LIMIT_S * US_PER_S:
                    raise SystemExit(f"not in the air after {LIMIT_S:g} s; {child.log_tail()}")
            pacing.restart(simulation.time_us)
            before = dict(watch.seconds)
            start_us, begun_s = simulation.time_us, time.perf_counter()
            while simulation.time_us - start_us < HOVER_S[mode] * US_PER_S:
                tick()
            wall_s = time.perf_counter() - begun_s
            simulated_s = (simulation.time_us - start_us) / US_PER_S
            spent = {part: total - before[part] for part, total in watch.seconds.items()}
            simulation.close()
        finally:
            child.stop()
            bridge.close()
            operator.close()
    return simulated_s / wall_s, round(simulated_s * 250), spent


if __name__ == "__main__":
    main()
