"""Step responses of a flight controller in lockstep, by the true state at every tick.

    python scripts/firmware_steps.py [--px4-dir DIR] [--px4-release 1.17] [--seeds 3] [--json FILE]

Flies the steps of `airl conformance` with a real PX4, or with the built-in flight controller, on
the same simulated vehicle. A step's time counts from the companion's call of MAVSDK. The stored
columns have the figures of --estimated: of LOCAL_POSITION_NED and ATTITUDE at 100 Hz.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from mavsdk.plugins.offboard import VelocityBodyYawspeed, VelocityNedYaw
from pymavlink.dialects.v20 import common as dialect

from airl_mav.addons.conformance import telemetry
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.progress import new_console
from airl_mav.lockstep.stage import LockstepStage
from airl_mav.lockstep.vehicle import VehicleEnd, builtin_vehicle, real_vehicle
from airl_mav.profiles.px4_release import PX4ReleaseName
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.vehicle.rotation import yaw_of
from firmware_sim.engine.dynamics import POSITION, QUATERNION, RATES, VELOCITY
from firmware_sim.external.px4_sitl import EPOCH_US
from firmware_sim.simulation import EpisodeSetup, Simulation

ALTITUDE_M, SETTLE_S = 10.0, 6.0


@dataclass(frozen=True)
class Command:
    """Fly step responses in lockstep."""

    px4_dir: Path | None = None
    """PX4's build or source tree; None = the built-in flight controller."""

    vehicle: str = "quad"
    """Vehicle profile."""

    seeds: int = 3
    """Flights with different sensor noise; every second one is mirrored."""

    instance: int = 0
    """First instance that is tried."""

    px4_release: PX4ReleaseName | None = None
    """Release of the built-in flight controller."""

    json: Path | None = None
    """File for the figures."""

    estimated: Path | None = None
    """File for the figures by the vehicle's telemetry."""


class Truth:
    """True motion of a flight."""

    def __init__(self) -> None:
        self._times: list[Any] = []
        self._motions: list[Any] = []

    def add(self, simulation: Simulation) -> None:
        """Add the newest ticks."""
        self._times.append(simulation.truths["time_us"].copy())
        self._motions.append(simulation.truths["motion"].copy())

    def motion(self) -> telemetry.EstimatedMotion:
        """Return the motion in the form of telemetry."""
        times_s = np.concatenate(self._times)[:, None] / US_PER_S
        rows = np.concatenate(self._motions)
        yaws = np.array([yaw_of(tuple(q)) for q in rows[:, QUATERNION]])[:, None]
        return telemetry.EstimatedMotion(
            np.hstack([times_s, rows[:, POSITION], rows[:, VELOCITY]]),
            np.hstack([times_s, yaws, rows[:, RATES][:, 2:]]),
        )


ESTIMATED = (dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, dialect.MAVLINK_MSG_ID_ATTITUDE)
RATE_HZ = 100.0
"""Rate of LOCAL_POSITION_NED; PX4 sends ATTITUDE as often unasked."""


class Telemetry(VehicleEnd):
    """Estimated motion of a flight, in front of the vehicle's end of the link."""

    def __init__(self, end: VehicleEnd) -> None:
        self._end = end
        self.answers_later = end.answers_later
        self._mav = dialect.MAVLink(None)
        self._rows: dict[int, list[tuple[float, ...]]] = {number: [] for number in ESTIMATED}

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        """Deliver a frame of the companion."""
        self._end.deliver(frame, carry_out, echo=echo)

    def settle(self) -> None:
        """Wait until the vehicle has finished all due work."""
        self._end.settle()

    def take(self) -> list[bytes]:
        """Return the received frames."""
        return self._read(self._end.take())

    def after_tick(self, *, expected: bool) -> list[bytes]:
        """Return the received frames, see `VehicleEnd`."""
        return self._read(self._end.after_tick(expected=expected))

    def motion(self, ahead_s: float) -> telemetry.EstimatedMotion:
        """Return the estimated motion; the vehicle's clock is ahead of simulated time."""
        parts = [np.array(self._rows[number]) for number in ESTIMATED]
        for part in parts:
            part[:, 0] -= ahead_s
        return telemetry.EstimatedMotion(*parts)

    def _read(self, frames: list[bytes]) -> list[bytes]:
        for frame in frames:
            number = int.from_bytes(frame[7:10], "little")
            if number in ESTIMATED and frame[6] == telemetry.AUTOPILOT_COMPONENT:
                m = self._mav.decode(bytearray(frame))
                names: tuple[str, ...] = ("yaw", "yawspeed")
                if number == dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
                    names = ("x", "y", "z", "vx", "vy", "vz")
                row = (getattr(m, name) for name in names)
                self._rows[number].append((m.time_boot_ms / 1e3, *row))
        return frames


Steps = dict[telemetry.StepName, telemetry.StepResponse]


def flown_steps(aircraft: Aircraft, seed: int) -> tuple[Steps, Steps]:
    """Return the responses of one flight, by step: from the true state, and from telemetry."""
    vehicle = load_vehicle(aircraft.vehicle, aircraft.px4_release)
    conducted = real_vehicle(aircraft, vehicle) or builtin_vehicle(SimClock())
    heard = Telemetry(conducted.end)
    conducted = replace(conducted, end=heard)
    truth, sent = Truth(), list[tuple[telemetry.HeldSetpoint, float]]()
    with LockstepStage(vehicle=conducted) as stage:

        def hold(leg: telemetry.HeldSetpoint) -> None:
            """Send a setpoint and wait."""
            frame, *values = leg.setpoint
            # The link has no NED setpoints.
            offboard: Any = stage.link._offboard
            sent.append((leg, stage.clock.time_us() / US_PER_S))
            if frame == "ned":
                offboard.set_velocity_ned(VelocityNedYaw(*values))
            else:
                offboard.set_velocity_body(VelocityBodyYawspeed(*values))
            stage.link.setpoints_sent += 1
            stage.clock.sleep_until(stage.clock.time_us() + round(leg.seconds * US_PER_S))

        def program() -> None:
            link, stop = stage.link, threading.Event()
            link.prepare(20.0, stop)
            link.arm(60.0, stop)
            link.takeoff(ALTITUDE_M, 60.0, stop)
            link.enter_offboard()
            plugin: Any = stage.link._telemetry
            plugin.set_rate_position_velocity_ned(RATE_HZ)
            hold(telemetry.HeldSetpoint(telemetry.STOP_NED, SETTLE_S))
            for leg in telemetry.plan(telemetry.STEP_NAMES, mirrored=seed % 2 == 0):
                hold(leg)
            link.leave_offboard()
            link.land(120.0)

        stage.firmware.on_ticks = truth.add
        stage.run(EpisodeSetup(vehicle, None, seed, aircraft=aircraft), program)
    # PX4's first sample, of the first tick, is at EPOCH_US of its clock.
    ahead_s = (EPOCH_US - TICK_US) / US_PER_S if aircraft.firmware == "px4" else 0.0
    return _measured(truth.motion(), sent), _measured(heard.motion(ahead_s), sent)


def _measured(
    motion: telemetry.EstimatedMotion, sent: list[tuple[telemetry.HeldSetpoint, float]]
) -> Steps:
    responses: Steps = {}
    for leg, sent_s in sent:
        if leg.step is not None:
            part = motion.between(sent_s - telemetry.BEFORE_S, sent_s + leg.seconds)
            responses[leg.step.name] = telemetry.measure(leg.step, part, sent_s)
    return responses


def mean_steps(flights: Sequence[Steps]) -> Steps:
    """Return the mean responses of several flights, by step."""
    return {
        name: telemetry.StepResponse(*np.mean([each[name] for each in flights], axis=0).tolist())
        for name in flights[0]
    }


def main(command: Command) -> int:
    """Print the responses."""
    firmware = {} if command.px4_dir is None else {"firmware": "px4"}
    aircraft = Aircraft(
        vehicle=command.vehicle,
        real={"px4_dir": command.px4_dir, "instance": command.instance},
        px4_release=command.px4_release,
        **firmware,
    )
    flights = [flown_steps(aircraft, seed) for seed in range(1, command.seeds + 1)]
    found, estimated = (mean_steps(each) for each in zip(*flights, strict=True))
    console = new_console(soft_wrap=True)
    for name, step in found.items():
        console.print(
            f"{name:14} latency {1e3 * step.latency_s:4.0f} t10 {1e3 * step.t10_s:4.0f} t50 "
            f"{1e3 * step.t50_s:5.0f} rise {1e3 * step.rise_s:5.0f} ms  overshoot "
            f"{step.overshoot_percent:5.1f} %  error {step.error:5.2f}  "
            f"settle {step.settle_s:4.2f} s"
        )
    for path, steps in ((command.json, found), (command.estimated, estimated)):
        if path is not None:
            plain = {name: step._asdict() for name, step in steps.items()}
            path.write_text(json.dumps(plain, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Command)))
