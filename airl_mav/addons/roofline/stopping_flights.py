"""Flights towards an obstacle that appears at the worst time: the fastest speed that stops.

They verify the safe velocity of `envs.stopping`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Shape
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.envs import stopping
from airl_mav.envs.arena_batch import ArenaBatch
from airl_mav.envs.fleet import Fleet, FlightStatus
from airl_mav.envs.fleet_step import advance
from airl_mav.latency.injection import FixedSampler, Injection, LatencySampler, latency_generator

WALL_HALF_M = (0.5, 20.0, 5.0)
"""Half extents of the obstacle: too wide to fly around [m]."""


SPEED_STEP_M_S = 0.01
"""Resolution of the search for the maximum collision-free speed [m/s]."""


_LEAST_SPEED_M_S = 0.01


def fly_into(
    task: stopping.StoppingTask,
    speed_m_s: float,
    latency: Injection,
    native_s: float,
    draws: int,
    seed: int,
) -> NDArray[np.bool_]:
    """Fly level towards an obstacle that appears at the worst time, and stop.

    A wall appears at the sensing distance, just after the capture of a decision's frame. Latencies,
    phase between camera and decision, and time since the start from hover differ between flights.

    Args:
        task: Vehicle, timing and sensing distance.
        speed_m_s: Speed of the setpoint before the stop, > 0 [m/s].
        latency: Source of t2.
        native_s: t2 without injection [s].
        draws: Number of flights, n.
        seed: Seed of flight 0; flight i draws from seed + i.

    Returns:
        (n,) True for flights that touched the obstacle.
    """
    rngs = [latency_generator(seed + i) for i in range(draws)]
    samplers = [latency.sampler(rng) or FixedSampler(_us(native_s)) for rng in rngs]
    # Separate generators, so that the latencies depend on the seed alone.
    others = [np.random.default_rng((seed + i, draws)) for i in range(draws)]
    phases = np.array([rng.random(2) for rng in others])
    reaction_us = _reactions_us(task.loop, samplers, phases[:, 0])
    shared = stopping.gym_constants_of(task.vehicle)
    moments = (phases[:, 1] * len(stopping.MOMENTS_S)).astype(np.int64)
    flying = stopping.run_ups(shared, [speed_m_s], stopping.MOMENTS_S)
    fleet = Fleet._make(array[moments] for array in flying)
    walls = _walls(fleet.position, task)
    # A setpoint takes effect at the flight controller's next tick.
    advance(fleet, walls, -(-reaction_us // TICK_US), shared, stopping.RULES, None)
    stopping.stop(fleet, walls, shared)
    touched: NDArray[np.bool_] = fleet.verdict == FlightStatus.COLLISION
    return touched


def greatest_speed(
    task: stopping.StoppingTask, latency: Injection, native_s: float, draws: int, seed: int
) -> float:
    """Return the maximum speed without a collision in `fly_into`, by bisection [m/s].

    At most the autopilot's maximum; 0 if the vehicle collides at any speed. Arguments as in
    `fly_into`.
    """

    def stands(speed_m_s: float) -> bool:
        return not fly_into(task, speed_m_s, latency, native_s, draws, seed).any()

    low, high = _LEAST_SPEED_M_S, stopping.braking_of(task.vehicle).fastest_m_s
    # The usual results first: no limit, or no speed at all.
    if stands(high):
        return high
    if not stands(low):
        return 0.0
    while high - low > SPEED_STEP_M_S:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stands(middle) else (low, middle)
    return low


def _us(time_s: float) -> int:
    return round(time_s * US_PER_S)


def _reactions_us(
    loop: stopping.DecisionLoop, samplers: list[LatencySampler], phases: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return the time of each flight from the obstacle's appearance to the motors (n,) [µs].

    The frame at time 0 does not show the obstacle, later frames do. Decisions use the newest
    decoded frame; the first one uses the frame of time 0.
    """
    period_us, transport_us = _us(loop.frame_period_s), _us(loop.transport_s)
    times = np.zeros(len(samplers), np.int64)
    for i, sampler in enumerate(samplers):
        observed_us = transport_us + int(phases[i] * period_us)
        sent_us = observed_us + sampler.sample_us()
        # Until the first frame after time 0 has been decoded.
        while observed_us < transport_us + period_us:
            observed_us = sent_us + _us(loop.hold_s)
            sent_us = observed_us + sampler.sample_us()
        times[i] = sent_us + _us(loop.link_s)
    return times


def _walls(position: NDArray[np.float64], task: stopping.StoppingTask) -> ArenaBatch:
    """Return a wall for each vehicle (n, 3), at the sensing distance from its camera."""
    walls = stopping.open_space(len(position), obstacles=1)
    walls.n_obstacles[:] = 1
    walls.shape[:] = Shape.BOX
    walls.half_size[:] = WALL_HALF_M
    lens = position[:, 0] + task.vehicle.camera.forward_m
    walls.center[:, 0, 0] = lens + task.sensing_distance_m + WALL_HALF_M[0]
    walls.center[:, 0, 2] = -stopping.ALTITUDE_M
    return walls
