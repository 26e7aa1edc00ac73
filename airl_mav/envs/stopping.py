"""How fast a vehicle may fly that stops for what its camera shows late; and the flights that try.

The worst moment for an obstacle to come up is just after a frame was taken that a decision is made
on: that decision flies on, for its inference and its hold, and only the next one stops.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Shape
from airl_mav.core.constants import MS_PER_S, TICK_S, TICK_US, US_PER_S
from airl_mav.core.errors import FieldError
from airl_mav.envs.arenas import ArenaBatch
from airl_mav.envs.braking import (
    ALTITUDE_M,
    MOMENTS_S,
    RULES,
    braking_of,
    open_space,
    run_ups,
    stop,
    twin_of,
)
from airl_mav.envs.fleet import Fleet, Verdict
from airl_mav.envs.flight import advance
from airl_mav.envs.spec import Delay
from airl_mav.latency.injection import Injection
from airl_mav.latency.samplers import FixedSampler, LatencySampler, latency_generator
from airl_mav.profiles.vehicle import VehicleProfile

WALL_HALF_M = (0.5, 20.0, 5.0)
"""Half extents of the obstacle: too wide to fly around."""

SPEED_STEP_M_S = 0.01
"""How closely the greatest speed without a touch is looked for."""

_LEAST_SPEED_M_S = 0.01


@dataclass(frozen=True)
class DecisionLoop:
    """When a companion sees and acts, but for the inference t2; simulated time."""

    frame_period_s: float
    transport_s: float
    """Frame taken -> decoded."""
    hold_s: float
    """Setpoint sent -> next observation."""
    link_s: float
    """Setpoint sent -> motors follow it."""

    @classmethod
    def of(cls, vehicle: VehicleProfile, hold_s: float, delay: Delay | None = None) -> DecisionLoop:
        """Return the loop of a vehicle's camera; without delays given, with the twin's own."""
        delay = delay or Delay()
        return cls(
            frame_period_s=vehicle.camera.period_us / US_PER_S,
            transport_s=delay.transport_ms / MS_PER_S,
            hold_s=hold_s,
            link_s=delay.link_ms / MS_PER_S,
        )

    def reaction_s(self, t2_s: float) -> float:
        """Return the longest time from an obstacle's coming up to the motors' answer [s].

        T = frame period + transport + t2 + hold + t2 + link, and a tick of the flight controller.
        The newest frame of a decision is up to a frame period and the transport old, and may just
        lack the obstacle. This decision infers and holds; the next one sees the obstacle, infers,
        and its setpoint goes out.

        Args:
            t2_s: The longest inference that is reckoned with [s].
        """
        waited = self.frame_period_s + self.transport_s
        return waited + t2_s + self.hold_s + t2_s + self.link_s + TICK_S

    def inference_s(self, reaction_s: float) -> float:
        """Return the longest inference with that reaction time [s]; below 0: there is none."""
        return 0.5 * (reaction_s - self.reaction_s(0.0))


@dataclass(frozen=True)
class StoppingTask:
    """A vehicle, how late it decides, and how far ahead it takes notice of an obstacle."""

    vehicle: VehicleProfile
    """With all that it carries."""
    loop: DecisionLoop
    sensing_distance_m: float
    """D: depth at which an obstacle is taken notice of, from the camera to its surface [m]."""

    @property
    def room_m(self) -> float:
        """How far the vehicle may move before its hull touches what the camera sees at D [m].

        The camera sits ahead of the centre of mass by its mount, the hull by half its width.
        """
        body, camera = self.vehicle.body, self.vehicle.camera
        return self.sensing_distance_m + camera.forward_m - 0.5 * body.width_m

    def safe_velocity(self, t2_s: float) -> float:
        """Return the greatest speed to command, with v T + brake(v) <= D but for the hull [m/s].

        At most what the autopilot flies.

        Args:
            t2_s: The longest inference that is reckoned with [s].

        Raises:
            FieldError: The hull reaches farther than the camera sees.
        """
        if self.room_m <= 0.0:
            hull_m = self.sensing_distance_m - self.room_m
            raise FieldError(
                "sensing_distance_m",
                self.sensing_distance_m,
                f"value > {hull_m:g} m, by which the hull stands out before the camera",
            )
        return braking_of(self.vehicle).safe_velocity(self.loop.reaction_s(t2_s), self.room_m)

    def inference_budget_s(self, speed_m_s: float) -> float:
        """Return the longest inference with which a speed is safe [s]; below 0: there is none.

        Args:
            speed_m_s: Of the setpoint, > 0 and at most what the autopilot flies [m/s].
        """
        braking = braking_of(self.vehicle)
        braked_m = braking.stopping_m(speed_m_s, 0.0)
        flown_m_s = braking.stopping_m(speed_m_s, 1.0) - braked_m
        return self.loop.inference_s((self.room_m - braked_m) / flown_m_s)


def fly_into(
    task: StoppingTask, speed_m_s: float, latency: Injection, native_s: float, draws: int, seed: int
) -> NDArray[np.bool_]:
    """Fly level at a speed towards an obstacle that comes up at the worst moment, and stop for it.

    A wall stands at the sensing distance from one moment on, just after a frame was taken that a
    decision is made on. Each flight has its own latencies, phase of camera to decision, and moment
    since the vehicle's start out of a hover.

    Args:
        task: What flies, and what it sees.
        speed_m_s: Of the setpoint until the vehicle is told to stop, > 0 [m/s].
        latency: Source of t2.
        native_s: t2 where that injects none [s].
        draws: Number of flights, n.
        seed: Of flight 0; flight i draws from seed + i.

    Returns:
        (n,) whether the vehicle touched the obstacle.
    """
    rngs = [latency_generator(seed + i) for i in range(draws)]
    samplers = [latency.sampler(rng) or FixedSampler(_us(native_s)) for rng in rngs]
    others = [np.random.default_rng((seed + i, draws)) for i in range(draws)]
    phases = np.array([rng.random(2) for rng in others])
    reaction_us = _reactions_us(task.loop, samplers, phases[:, 0])
    shared = twin_of(task.vehicle)
    moments = (phases[:, 1] * len(MOMENTS_S)).astype(np.int64)
    flying = run_ups(shared, [speed_m_s], MOMENTS_S)
    fleet = Fleet._make(array[moments] for array in flying)
    walls = _walls(fleet.position, task)
    # A setpoint waits for the flight controller's next tick.
    advance(fleet, walls, -(-reaction_us // TICK_US), shared, RULES, None)
    stop(fleet, walls, shared)
    touched: NDArray[np.bool_] = fleet.verdict == Verdict.COLLISION
    return touched


def greatest_speed(
    task: StoppingTask, latency: Injection, native_s: float, draws: int, seed: int
) -> float:
    """Return the greatest speed at which no flight of `fly_into` touches, by bisection [m/s].

    At most what the autopilot flies; 0 where the vehicle touches at any speed. Arguments as of
    `fly_into`.
    """

    def stands(speed_m_s: float) -> bool:
        return not fly_into(task, speed_m_s, latency, native_s, draws, seed).any()

    low, high = _LEAST_SPEED_M_S, braking_of(task.vehicle).fastest_m_s
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
    loop: DecisionLoop, samplers: list[LatencySampler], phases: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return how long each flight takes from the obstacle's coming up to the motors (n,) [µs].

    The frame at time 0 lacks the obstacle, those a period later and on have it. Decisions are made
    on the newest decoded frame, the first of them on that of time 0.
    """
    period_us, transport_us = _us(loop.frame_period_s), _us(loop.transport_s)
    times = np.zeros(len(samplers), np.int64)
    for i, sampler in enumerate(samplers):
        observed_us = transport_us + int(phases[i] * period_us)
        sent_us = observed_us + sampler.sample_us()
        while observed_us < transport_us + period_us:
            observed_us = sent_us + _us(loop.hold_s)
            sent_us = observed_us + sampler.sample_us()
        times[i] = sent_us + _us(loop.link_s)
    return times


def _walls(position: NDArray[np.float64], task: StoppingTask) -> ArenaBatch:
    """Return a wall for each vehicle (n, 3) that its camera sees at the sensing distance."""
    walls = open_space(len(position), obstacles=1)
    walls.n_obstacles[:] = 1
    walls.shape[:] = Shape.BOX
    walls.half_size[:] = WALL_HALF_M
    lens = position[:, 0] + task.vehicle.camera.forward_m
    walls.center[:, 0, 0] = lens + task.sensing_distance_m + WALL_HALF_M[0]
    walls.center[:, 0, 2] = -ALTITUDE_M
    return walls
