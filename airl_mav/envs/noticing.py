"""At which depth a learned policy takes notice of an obstacle: where its action changes for it."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Shape
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.envs.braking import ALTITUDE_M, open_space, twin_of
from airl_mav.envs.cameras import Cameras
from airl_mav.envs.fleet import hover, new_fleet
from airl_mav.policy.action_sets import commands
from airl_mav.policy.layouts import encode_layout
from airl_mav.policy.learned import LearnedPolicy
from airl_mav.policy.observation import InFlight, Kinematics, observe
from airl_mav.profiles.conditions import SensorNoise
from airl_mav.profiles.vehicle import VehicleProfile

HALF_WIDTHS_M = (0.5, 1.0, 1.5)
"""Of the box ahead: from the narrowest to the widest of the shipped arenas."""

ASIDE = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""How far the box's middle lies beside the vehicle's way, in its half widths: always in the way."""

GOALS = ((15.0, 0.0), (25.0, -0.3), (25.0, 0.0), (25.0, 0.3), (40.0, 0.0))
"""Distance [m] and bearing [rad] of the goal."""

STEP_M = 0.2
HALF_HEIGHT_M = 2.0

SAME = 0.01
"""Commands that differ by less than this share of the fastest are the same."""


def noticed_m(policy: LearnedPolicy, vehicle: VehicleProfile) -> NDArray[np.float64]:
    """Return at which depths a policy takes notice of a box ahead, one a situation (75,) [m].

    The vehicle flies level and straight at the policy's fastest speed, and the box is in its way.
    The depth is the greatest from which on, at every smaller one, the policy does another thing
    than in open space; 0 where there is none.

    Args:
        policy: Its camera must be the vehicle's.
        vehicle: With the camera.
    """
    camera, card = vehicle.camera, policy.card
    depths = np.arange(STEP_M, camera.range_m, STEP_M)
    n = len(depths) + 1  # the last one flies in open space
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
        # As at the first decision of a flight, where the policy has a memory.
        fresh = policy.with_generator(np.random.default_rng(0)) if card.state else policy
        chosen = commands(card.actions, fresh.act_batch(encode_layout(card.observation, seen)))
        moved = np.abs(chosen[:-1] - chosen[-1]).max(axis=1)
        ignored = np.flatnonzero(moved <= SAME * card.actions.max_speed_m_s)
        reach = ignored[0] if ignored.size else len(depths)
        found.append(depths[reach - 1] if reach else 0.0)
    return np.array(found)
