"""The way from a speed to a stand, measured on the batch twin.

A vehicle has to tilt before it brakes, and its autopilot drives the velocity towards the setpoint
rather than braking as hard as the tilt limit permits: at low speeds the way to a stand grows with
the speed, not with its square. So it is flown: vehicles fly level from a hover at many speeds, and
at many moments of that get a setpoint of zero velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import cache

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from airl_mav.core.constants import TICK_S
from airl_mav.core.errors import UsageError
from airl_mav.core.fields import ProfileModel, validated
from airl_mav.core.files import read_json, write_json
from airl_mav.core.kernels import cache_folder
from airl_mav.envs.arenas import ArenaBatch, empty_batch
from airl_mav.envs.fleet import Fleet, Rules, Vehicle, hover, new_fleet, vehicle_of
from airl_mav.envs.flight import advance
from airl_mav.profiles.loading import profile_digest
from airl_mav.profiles.parameters import flown_values
from airl_mav.profiles.vehicle import VehicleProfile

SCHEMA = 1
"""Version of the stored measurement."""

SPEEDS = 24
"""Commanded speeds that are flown, evenly up to the fastest that the autopilot flies."""

MOMENTS_S = tuple(float(each) for each in np.arange(0.25, 8.01, 0.25))
"""Times after the start from the hover at which a vehicle is told to stop [s]. The velocity loop
overshoots its setpoint by 3 % after three seconds and comes down to it within twenty: the fastest
and longest of these moments counts."""

ALTITUDE_M = 2.5

FAR_M = 1e6
"""Where walls and goal are, so that nothing but what is meant ends a flight [m]."""

RULES = Rules(goal_radius=1.0, time_limit_us=1 << 60)
"""Nothing but a collision ends a flight."""

_STEP_TICKS = 5
"""The place of a vehicle is noted so often while it brakes: 20 ms from its turning point it is
less than a millimetre away."""

_LONGEST_STOP_S = 60.0


class Braking(ProfileModel):
    """What a vehicle does that is told to fly at a speed and then to stand: n speeds, ascending.

    It is told to stop at the worst moment since its start.
    """

    vehicle_sha256: str
    """Digest of the vehicle, with all that it carries."""
    commanded_m_s: tuple[float, ...]
    """Speed of the setpoint [m/s]."""
    flown_m_s: tuple[float, ...]
    """Greatest speed that the vehicle reached on it [m/s]."""
    distance_m: tuple[float, ...]
    """Longest way from the setpoint of zero velocity to a stand [m]."""

    @property
    def fastest_m_s(self) -> float:
        """The greatest speed that was commanded: the autopilot flies none beyond it [m/s]."""
        return self.commanded_m_s[-1]

    def stopping_m(self, commanded_m_s: float, reaction_s: float) -> float:
        """Return the way until a vehicle stands that is told to after a reaction time [m].

        Args:
            commanded_m_s: Speed of its setpoint until then, 0 to `fastest_m_s` [m/s].
            reaction_s: How long it flies on [s].
        """
        flown, distance = self._curves
        return float(flown(commanded_m_s) * reaction_s + distance(commanded_m_s))

    def safe_velocity(self, reaction_s: float, room_m: float) -> float:
        """Return the greatest commanded speed from which the vehicle stands within a room [m/s].

        At most `fastest_m_s`.

        Args:
            reaction_s: How long it flies on before it is told to stop, >= 0 [s].
            room_m: How far it may move in all, > 0 [m].
        """
        top = self.fastest_m_s
        if self.stopping_m(top, reaction_s) <= room_m:
            return top
        found = scipy.optimize.brentq(lambda v: self.stopping_m(v, reaction_s) - room_m, 0.0, top)
        return float(found)

    def distance_from_m(self, speed_m_s: float) -> float:
        """Return the way from a true speed to a stand [m]; beyond what was flown, as v² has it."""
        flown, distance = np.array([0.0, *self.flown_m_s]), np.array([0.0, *self.distance_m])
        beyond = max(1.0, speed_m_s / float(flown[-1])) ** 2
        return float(np.interp(speed_m_s, flown, distance)) * beyond

    @property
    def _curves(
        self,
    ) -> tuple[scipy.interpolate.PchipInterpolator, scipy.interpolate.PchipInterpolator]:
        at = np.array([0.0, *self.commanded_m_s])
        return (
            scipy.interpolate.PchipInterpolator(at, [0.0, *self.flown_m_s]),
            scipy.interpolate.PchipInterpolator(at, [0.0, *self.distance_m]),
        )


def braking_of(vehicle: VehicleProfile) -> Braking:
    """Return the braking of a vehicle, with all that it carries: measured once, and stored.

    The measurement lies beside the compiled kernels, in a folder of this source and all that it
    imports, under the digest of the vehicle: another payload, computer or parameter is another one.
    """
    return _braking(vehicle.model_dump_json())


@cache
def _braking(vehicle_json: str) -> Braking:
    vehicle = VehicleProfile.model_validate_json(vehicle_json)
    folder = cache_folder(__file__)
    if folder is None:
        return measure_braking(vehicle)
    path = folder / f"braking-{profile_digest(vehicle)[:16]}.json"
    with suppress(UsageError):
        stored = read_json(path, SCHEMA, "braking")
        del stored["schema"]
        return validated(Braking, stored, path)
    measured = measure_braking(vehicle)
    with suppress(OSError):
        write_json(path, {"schema": SCHEMA, **measured.model_dump()})
    return measured


def measure_braking(vehicle: VehicleProfile) -> Braking:
    """Fly a vehicle at all speeds and stop it at all moments; see `Braking`. Half a second."""
    shared = twin_of(vehicle)
    top_m_s = shared.gains.vel_max_xy
    speeds = top_m_s * np.arange(1, SPEEDS + 1) / SPEEDS
    fleet = run_ups(shared, speeds, MOMENTS_S)
    shape = (len(MOMENTS_S), SPEEDS)
    flown = np.hypot(fleet.velocity[:, 0], fleet.velocity[:, 1]).reshape(shape).max(axis=0)
    start = fleet.position[:, 0].copy()
    stop(fleet, open_space(len(start)), shared)
    distance = (fleet.position[:, 0] - start).reshape(shape).max(axis=0)
    # A faster command never counts for less: what the tilt limit cuts off is flat but for noise.
    return Braking(
        vehicle_sha256=profile_digest(vehicle),
        commanded_m_s=tuple(speeds.tolist()),
        flown_m_s=tuple(np.maximum.accumulate(flown).tolist()),
        distance_m=tuple(np.maximum.accumulate(distance).tolist()),
    )


def twin_of(vehicle: VehicleProfile) -> Vehicle:
    """Return the batch twin's constants of a vehicle on its own parameters."""
    return vehicle_of(vehicle, flown_values(vehicle.autopilot_parameters()).__getitem__)


def open_space(n: int, obstacles: int = 0) -> ArenaBatch:
    """Return n arenas without walls in reach, and room for obstacles that are not there yet."""
    batch = empty_batch(n, obstacles, 0, 0)
    batch.bounds[:] = [-FAR_M, FAR_M, -FAR_M, FAR_M, 1e-3, 0.0]
    batch.goal[:, :2] = [-FAR_M, 0.0]
    batch.n_static[:] = obstacles
    return batch


def run_ups(vehicle: Vehicle, speeds: ArrayLike, moments_s: Sequence[float]) -> Fleet:
    """Return vehicles at moments of their flight north from a hover, on setpoints of some speeds.

    Args:
        vehicle: What flies.
        speeds: (n,) of the setpoints [m/s].
        moments_s: k times since the start, ascending [s].

    Returns:
        n k vehicles: those of the first moment first.
    """
    wanted = np.asarray(speeds, np.float64)
    n = len(wanted)
    fleet, arenas = new_fleet(n), open_space(n)
    for i in range(n):
        hover(fleet, i, ALTITUDE_M, vehicle)
    fleet.setpoint[:, 0] = wanted
    taken, flown = [], 0
    for moment in moments_s:
        ticks = round(moment / TICK_S)
        advance(fleet, arenas, np.full(n, ticks - flown, np.int64), vehicle, RULES, None)
        flown = ticks
        taken.append(Fleet._make(array.copy() for array in fleet))
    return Fleet._make(np.concatenate(arrays) for arrays in zip(*taken, strict=True))


def stop(fleet: Fleet, arenas: ArenaBatch, vehicle: Vehicle) -> None:
    """Give all vehicles a setpoint of zero velocity and fly them until none moves north.

    A vehicle stays at its farthest point, or where it touches something.
    """
    fleet.setpoint[:] = 0.0
    fleet.repeat_us[:] = fleet.time_us
    moving = np.ones(len(fleet.time_us), np.bool_)
    for _ in range(round(_LONGEST_STOP_S / (_STEP_TICKS * TICK_S))):
        before: NDArray[np.float64] = fleet.position[:, 0].copy()
        advance(fleet, arenas, np.where(moving, _STEP_TICKS, 0), vehicle, RULES, None)
        moving &= fleet.position[:, 0] > before
        if not moving.any():
            return
