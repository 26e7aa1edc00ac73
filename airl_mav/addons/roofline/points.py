"""Roofline of a vehicle: safe speed over decision rate, and computers on it.

Based on the F-1 model (`latency.f1_model`), with measured braking, and verified in flights.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from airl_mav.addons.roofline.stopping_flights import greatest_speed
from airl_mav.arena.geometry import Shape
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import G_PER_KG, MS_PER_S, TICK_S
from airl_mav.core.fields import ProfileModel
from airl_mav.envs.cameras import Cameras
from airl_mav.envs.fleet import hover, new_fleet
from airl_mav.envs.stopping import (
    ALTITUDE_M,
    Braking,
    StoppingTask,
    braking_of,
    open_space,
    twin_of,
)
from airl_mav.flight.energy import level_powers_w
from airl_mav.latency.injection import Injection, longest_ms
from airl_mav.latency.stages import f1_knee_hz, f1_velocity, max_acceleration
from airl_mav.policy.actions import commands
from airl_mav.policy.layouts import encode_layout
from airl_mav.policy.learned import LearnedPolicy
from airl_mav.policy.observation import InFlight, Kinematics, observe
from airl_mav.profiles.computer import ComputerProfile
from airl_mav.profiles.conditions import SensorNoise
from airl_mav.profiles.vehicle import VehicleProfile

Bound = Literal["body", "sensor", "computer", "hold", "link"]
"""Component that limits the speed."""


class Shares(ProfileModel):
    """Contributions to the longest reaction time [s]."""

    sensor: float
    """Frame period and transport."""
    computer: float
    """Twice the longest t2."""
    hold: float
    """Hold time of the policy's action."""
    link: float
    """Link, and a tick of the flight controller."""


class RooflinePoint(ProfileModel):
    """Computer on the roofline of its vehicle."""

    computer: str
    description: str
    mass_g: float
    """Mass on board [g]."""
    watts: float
    """Power from the pack [W]."""
    latency: str
    """Description of t2."""
    vehicle_kg: float
    room_m: float
    """Sensing distance minus the hull's overhang: d of the model [m]."""
    reaction_s: float
    """T: time from an obstacle's appearance to the motors' response [s]."""
    shares: Shares
    max_acceleration_m_s2: float
    """a of the F-1 model: tilt limit and thrust [m/s²]."""
    f1_m_s: float
    """Safe velocity by the F-1 model [m/s]."""
    f1_roof_m_s: float
    f1_knee_hz: float
    braking: Braking
    measured_m_s: float
    """Safe velocity by the measured braking [m/s]."""
    roof_m_s: float
    """Safe velocity by the measured braking at T = 0 [m/s]."""
    knee_hz: float
    """Rate 1 / T at which the safe velocity reaches `knee_share` of the roof [Hz]."""
    flown_m_s: float
    """Maximum speed without a collision in any flight [m/s]."""
    binds: Bound
    power_w: float
    """Power of level flight at the measured safe velocity, with the computer [W]."""
    missions_per_charge: float

    @property
    def rate_hz(self) -> float:
        """Decision rate 1 / T [Hz]."""
        return 1.0 / self.reaction_s


class LeftOut(ProfileModel):
    """Computer that is not on the roofline, and the reason."""

    computer: str
    why: str


class Roofline(ProfileModel):
    """Roofline of a vehicle and its computers."""

    vehicle: str
    policy: str
    workload: str
    sensing_distance_m: float
    noticed_m: tuple[float, ...] = Field(description="depths at which the policy took notice")
    """Depths at which the policy reacts [m]; empty if the sensing distance was given."""
    frame_rate_hz: float
    hold_s: float
    knee_share: float
    mission_m: float
    draws: int
    seed: int
    points: tuple[RooflinePoint, ...]
    left_out: tuple[LeftOut, ...] = ()


def roofline_point(
    name: str,
    computer: ComputerProfile,
    task: StoppingTask,
    injection: Injection,
    *,
    knee_share: float,
    mission_m: float,
    draws: int,
    seed: int,
) -> RooflinePoint:
    """Compute a computer's point on the roofline of its vehicle, and fly it.

    Args:
        name: Name of the computer's profile.
        computer: The computer.
        task: The vehicle with this computer, its decision loop and its sensing distance.
        injection: t2 as measured on the computer; must have a latency.
        knee_share: Share of the roof at which the knee lies, 0 < q < 1.
        mission_m: Length of a mission [m].
        draws: Flights at each tested speed.
        seed: Seed of the draws.

    Raises:
        ValueError: The injection has no latency.
        FieldError: The sensing distance ends within the hull.
    """
    if injection.latency is None:
        raise ValueError(f"{name}: no latency")
    t2_s = longest_ms(injection.latency) / MS_PER_S
    loop, vehicle = task.loop, task.vehicle
    measured, reaction = task.safe_velocity(t2_s), loop.reaction_s(t2_s)
    parts: dict[Bound, float] = {
        "sensor": loop.frame_period_s + loop.transport_s,
        "computer": 2.0 * t2_s,
        "hold": loop.hold_s,
        "link": loop.link_s + TICK_S,
    }
    braking, room, a = braking_of(vehicle), task.room_m, max_acceleration(vehicle)
    roof = braking.safe_velocity(0.0, room)
    at_knee = knee_share * roof
    braked = braking.stopping_m(at_knee, 0.0)
    knee_hz = (braking.stopping_m(at_knee, 1.0) - braked) / (room - braked)
    power_w = float(level_powers_w(vehicle, np.array([measured]))[0]) + computer.onboard_watts
    pack_j = vehicle.battery.energy_j(1.0)
    return RooflinePoint(
        computer=name,
        description=computer.description,
        mass_g=G_PER_KG * computer.onboard_mass_kg,
        watts=computer.onboard_watts,
        latency=injection.label,
        vehicle_kg=vehicle.body.mass_kg,
        room_m=room,
        reaction_s=reaction,
        shares=Shares(**parts),
        max_acceleration_m_s2=a,
        f1_m_s=f1_velocity(reaction, room, a),
        f1_roof_m_s=f1_velocity(0.0, room, a),
        f1_knee_hz=f1_knee_hz(knee_share, room, a),
        braking=braking,
        measured_m_s=measured,
        roof_m_s=roof,
        knee_hz=knee_hz,
        flown_m_s=greatest_speed(task, injection, t2_s, draws, seed),
        binds="body" if 1.0 / reaction >= knee_hz else max(parts, key=lambda part: parts[part]),
        power_w=power_w,
        missions_per_charge=pack_j * measured / (power_w * mission_m),
    )


HALF_WIDTHS_M = (0.5, 1.0, 1.5)
"""Half widths of the box ahead, covering the built-in arenas [m]."""

ASIDE = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Offset of the box's middle from the flight path, in half widths; it is always in the way."""

GOALS = ((15.0, 0.0), (25.0, -0.3), (25.0, 0.0), (25.0, 0.3), (40.0, 0.0))
"""Distance [m] and bearing [rad] of the goal."""

STEP_M = 0.2
HALF_HEIGHT_M = 2.0

SAME = 0.01
"""Tolerance for equal commands, relative to the maximum speed."""


def noticed_m(policy: LearnedPolicy, vehicle: VehicleProfile) -> NDArray[np.float64]:
    """Return the depths at which a policy reacts to a box ahead, one per situation (75,) [m].

    The vehicle flies level and straight at the policy's maximum speed towards the box. The depth is
    the maximum at which, as at all smaller depths, the action differs from the action in open
    space; 0 = no such depth.

    Args:
        policy: Its camera must match the vehicle's.
        vehicle: Vehicle with the camera.
    """
    camera, card = vehicle.camera, policy.card
    depths = np.arange(STEP_M, camera.range_m, STEP_M)
    n = len(depths) + 1  # the last row flies in open space
    fleet, arenas, shared = new_fleet(n), open_space(n, obstacles=1), twin_of(vehicle)
    for i in range(n):
        hover(fleet, i, ALTITUDE_M, shared)
    fleet.velocity[:, 0] = card.actions.max_speed_m_s
    arenas.n_obstacles[:-1] = 1
    arenas.shape[:] = Shape.BOX
    cameras = Cameras(n, camera, 0, SensorNoise())
    found = []
    for half_m, aside, (away_m, bearing) in product(HALF_WIDTHS_M, ASIDE, GOALS):
        arenas.half_size[:] = (half_m, half_m, HALF_HEIGHT_M)
        arenas.center[:-1, 0, 0] = camera.forward_m + depths + half_m
        arenas.center[:-1, 0, 1] = aside * half_m
        arenas.center[:-1, 0, 2] = -HALF_HEIGHT_M
        arenas.goal[:, :2] = (away_m * math.cos(bearing), away_m * math.sin(bearing))
        cameras.capture(fleet, arenas, np.ones(n, np.bool_), np.zeros(n, np.int64))
        state = Kinematics(fleet.position, fleet.velocity, fleet.quaternion)
        seen = observe(
            *(cameras.image, Intrinsics.of(camera), state, arenas.goal[:, :2]),
            InFlight.of_first_decisions(n),
        )
        # For policies with memory: the first decision of a flight.
        fresh = policy.with_generator(np.random.default_rng(0)) if card.state else policy
        chosen = commands(card.actions, fresh.act_batch(encode_layout(card.observation, seen)))
        moved = np.abs(chosen[:-1] - chosen[-1]).max(axis=1)
        ignored = np.flatnonzero(moved <= SAME * card.actions.max_speed_m_s)
        reach = ignored[0] if ignored.size else len(depths)
        found.append(depths[reach - 1] if reach else 0.0)
    return np.array(found)
