"""Comparison of height estimates over a box: a real PX4 and the built-in autopilot.

    python scripts/rangefinder_compared.py --px4-dir ~/PX4-Autopilot/build/px4_sitl_default
    python scripts/rangefinder_compared.py --px4-dir ... --parameters EKF2_HGT_REF=2 EKF2_RNG_CTRL=2

Both receive the same MAVLink commands, in simulated time: climb to 2.5 m, 12 m north over a box of
1 m height, and land. Their estimates of the ground below (ALTITUDE.bottom_clearance) and of height
(LOCAL_POSITION_NED) are compared with the truth if the ray meets floor or box 0.5 m or more from an
edge. Prints a line for each flight.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from rich.table import Table

from airl_mav.arena.geometry import Arena, Bounds, Obstacles
from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import EXIT_USAGE, UsageError
from airl_mav.core.progress import new_console
from airl_mav.lockstep.vehicle import builtin_vehicle, real_vehicle
from airl_mav.profiles.vehicle import VehicleProfile, load_vehicle
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.firmware import Firmware
from firmware_sim.mavlink.codec import Encoder, WireMessage, dialect
from firmware_sim.pacing import Unpaced
from firmware_sim.simulation import EpisodeSetup

BOX_NORTH_M, BOX_HALF_M, BOX_HIGH_M = 6.0, 1.5, 1.0
FLOWN_AT_M, WAY_M, SPEED_M_S = 2.5, 12.0, 1.0
EDGE_M = 0.5
"""Excluded distance from an edge of the box, because a tilted ray may meet the other side."""
CLIMB_S, HOVER_S, LIMIT_S = 8.0, 3.0, 60.0
SETPOINT_US, COMMAND_US = US_PER_S // 20, US_PER_S
PLACE_AND_YAW = 0b1001_1111_1000
"""SET_POSITION_TARGET_LOCAL_NED.type_mask: velocity, acceleration and yaw rate are ignored."""
OFFBOARD = 6
US = (255, 190)


@dataclass(frozen=True)
class Asked:
    """Compare the estimates with a rangefinder."""

    px4_dir: Path | None = None
    """Build folder of a real PX4; None = the built-in autopilot alone."""

    vehicle: str = "quad-indoor"
    """Vehicle profile."""

    seeds: int = 3
    """Flights of each autopilot."""

    seed: int = 1
    """First seed."""

    parameters: tuple[str, ...] = field(default=())
    """Parameters for both, as NAME=VALUE."""

    faults: tuple[str, ...] = field(default=())
    """Faults for both, as "rangefinder stuck at 12s"."""


@dataclass(frozen=True)
class Found:
    """Result of a flight; errors are estimated minus true."""

    over_floor_m: float
    """Mean of bottom_clearance over the floor, minus the true height."""
    over_box_m: float
    """Mean of bottom_clearance over the box, minus the true height."""
    clearance_rms_m: float
    height_rms_m: float
    """RMS error of local z, from its value on the ground."""
    known: float
    """Share of ALTITUDE messages with a clearance, in flight."""
    landing_s: float
    """Time from the land command to disarming; NaN = not within a minute."""
    crawl_m_s: float
    """Mean true speed of descent between 0.6 and 0.2 m above the ground."""


def arena() -> Arena:
    """Return a room with one box."""
    return Arena(
        "one-box",
        0,
        Bounds(-20.0, 40.0, -20.0, 20.0, 6.0),
        (200, 200, 200),
        Obstacles(
            np.zeros(1, np.int8),
            np.array([[BOX_NORTH_M, 0.0, -0.5 * BOX_HIGH_M]]),
            np.array([[BOX_HALF_M, BOX_HALF_M, 0.5 * BOX_HIGH_M]]),
            np.zeros(1),
        ),
        (),
        np.array([30.0, 0.0]),
    )


class Flight:
    """Flight controlled by MAVLink."""

    def __init__(self, vehicle: VehicleProfile, aircraft: Aircraft, seed: int) -> None:
        pacing = Unpaced()
        real = real_vehicle(aircraft, vehicle)
        conducted = builtin_vehicle(pacing.clock) if real is None else real
        self._end, self._is_real = conducted.end, real is not None
        self._firmware = Firmware(conducted.stack, None, pacing, recording=False)
        self._encoder, self._parser = Encoder(*US), dialect.MAVLink(None)
        self._setup = EpisodeSetup(vehicle, arena(), seed, aircraft)
        self._armed = False
        self._climbs = self._lands = False
        self._crosses_us = 0
        self._z: float = math.nan
        self._z0: float = math.nan
        self._rows: list[tuple[int, float, float, float, float]] = []
        """Time [µs], true north and down, local z minus its value on the ground, clearance [m]."""

    def fly(self) -> Found:
        """Fly the flight; return its result."""
        firmware = self._firmware
        try:
            firmware.load(self._setup, None, 0)
            self._end.take()
            return self._fly()
        finally:
            firmware.close()

    def _fly(self) -> Found:
        begun = self._until(lambda: self._armed, self._take_off)
        self._until(lambda: self._now_us - begun > CLIMB_S * US_PER_S, self._climb)
        self._crosses_us = self._now_us
        way_us = (WAY_M / SPEED_M_S + HOVER_S) * US_PER_S
        self._until(lambda: self._now_us - self._crosses_us > way_us, self._cross)
        aloft = len(self._rows)
        asked = self._now_us
        over_us = asked + LIMIT_S * US_PER_S
        landed = self._until(lambda: not self._armed or self._now_us >= over_us, self._land)
        landing_s = math.nan if self._armed else (landed - asked) / US_PER_S
        return self._found(aloft, landing_s)

    @property
    def _now_us(self) -> int:
        return self._firmware.clock.time_us()

    def _until(self, met: object, act: object) -> int:
        began = self._now_us
        while not met():  # type: ignore[operator]
            if self._now_us - began > LIMIT_S * US_PER_S:
                raise UsageError("the flight did not go on within a minute")
            if self._now_us % SETPOINT_US < 4_000:
                act()  # type: ignore[operator]
            self._firmware.step()
            for chunk in self._end.after_tick(expected=False):
                for message in self._parser.parse_buffer(chunk) or ():
                    self._hear(message)
        return self._now_us

    def _hear(self, message: WireMessage) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT" and message.get_srcComponent() == 1:
            self._armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        elif kind == "LOCAL_POSITION_NED":
            self._z = message.z
            if not self._armed:
                self._z0 = message.z
        elif kind == "ALTITUDE" and self._armed:
            simulation = self._firmware.simulation
            assert simulation is not None
            north, _, down = simulation.plant.position
            row = (self._now_us, north, down, self._z - self._z0, message.bottom_clearance)
            self._rows.append(row)

    # --- commands

    def _take_off(self) -> None:
        if self._now_us % COMMAND_US < SETPOINT_US:
            if not self._is_real and (place := self._setup.vehicle.told_origin) is not None:
                # A real PX4 gets its origin from the observer of its boot.
                degrees = round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7)
                height_mm = round(place.altitude_m * 1e3)
                self._send(dialect.MAVLink_set_gps_global_origin_message(1, *degrees, height_mm, 0))
            self._command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def _climb(self) -> None:
        if not self._climbs:
            self._climbs = True
            self._command(dialect.MAV_CMD_NAV_TAKEOFF, *(math.nan,) * 7)

    def _cross(self) -> None:
        if self._now_us % COMMAND_US < SETPOINT_US:
            self._command(dialect.MAV_CMD_DO_SET_MODE, 1, OFFBOARD)
        self._go()

    def _go(self) -> None:
        flown_s = (self._now_us - self._crosses_us) / US_PER_S
        north = min(WAY_M, SPEED_M_S * flown_s)
        nothing = (0.0,) * 6
        message = dialect.MAVLink_set_position_target_local_ned_message(
            *(0, 1, 1, dialect.MAV_FRAME_LOCAL_NED, PLACE_AND_YAW),
            *(north, 0.0, self._z0 - FLOWN_AT_M, *nothing, 0.0, 0.0),
        )
        self._send(message)

    def _land(self) -> None:
        if not self._lands:
            self._lands = True
            self._command(dialect.MAV_CMD_NAV_LAND, *(math.nan,) * 7)

    def _command(self, command: int, *values: float) -> None:
        given = (*values, *(0.0,) * (7 - len(values)))
        self._send(dialect.MAVLink_command_long_message(1, 1, command, 0, *given))

    def _send(self, message: object) -> None:
        frame = self._encoder.pack(message)
        firmware = self._firmware
        self._end.deliver(frame, lambda: firmware.flight_stack.receive(self._now_us), echo=False)

    # --- results

    def _found(self, aloft: int, landing_s: float) -> Found:
        rows = np.array(self._rows)
        time, north, down, z, clearance = rows.T
        crossing = np.arange(len(rows)) < aloft
        crossing &= time > self._crosses_us
        off = np.abs(north - BOX_NORTH_M) - BOX_HALF_M
        over_box, over_floor = crossing & (off < -EDGE_M), crossing & (off > EDGE_M)
        true = -down - np.where(off < 0.0, BOX_HIGH_M, 0.0)
        rest = down[0]
        error, height = clearance - true, z - (down - rest)
        clear = over_box | over_floor
        fell = np.arange(len(rows)) >= aloft
        near = fell & (true > 0.2) & (true < 0.6)
        spent_s = float(np.ptp(time[near])) / US_PER_S if near.any() else math.nan
        return Found(
            float(error[over_floor].mean()),
            float(error[over_box].mean()),
            float(np.sqrt(np.mean(error[clear] ** 2))),
            float(np.sqrt(np.mean(height[crossing] ** 2))),
            float(np.isfinite(clearance[crossing]).mean()),
            landing_s,
            float(np.ptp(true[near])) / spent_s if near.any() else math.nan,
        )


def changed(vehicle: VehicleProfile, words: Sequence[str]) -> VehicleProfile:
    """Return the vehicle with other parameters, for either autopilot."""
    more = {name: float(value) for name, _, value in (word.partition("=") for word in words)}
    data = vehicle.model_dump()
    data["parameters"].update(more)
    data["px4"]["parameters"].update(
        {
            name: int(v) if v == int(v) and name.endswith(("_REF", "_CTRL")) else v
            for name, v in more.items()
        }
    )
    return VehicleProfile.model_validate(data)


def main(words: Sequence[str] | None = None) -> int:
    """Compare, and print the results."""
    asked, console = tyro.cli(Asked, args=words), new_console()
    vehicle = changed(load_vehicle(asked.vehicle), asked.parameters)
    failing = {"faults": asked.faults}
    kinds = {"built-in": Aircraft.model_validate(failing)}
    if asked.px4_dir is not None:
        real = {"px4_dir": asked.px4_dir}
        kinds["PX4"] = Aircraft.model_validate({**failing, "firmware": "px4", "real": real})
    names = ("floor", "box", "rms", "height rms", "known", "landing s", "crawl m/s")
    table = Table("autopilot", "seed", *names)
    for seed in range(asked.seed, asked.seed + asked.seeds):
        for name, aircraft in kinds.items():
            found = Flight(vehicle, aircraft, seed).fly()
            row = (f"{value:.3f}" for value in vars(found).values())
            table.add_row(name, str(seed), *row)
    console.print(table)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except UsageError as error:
        print(error, file=sys.stderr)
        sys.exit(EXIT_USAGE)
