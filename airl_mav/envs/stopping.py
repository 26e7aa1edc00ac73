"""Safe velocity with delayed camera images: stopping distance and its measurement.

In the worst case an obstacle appears just after the capture of a decision's frame: this decision
ignores the obstacle during inference and hold, and only the next one stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from airl_mav.core.constants import MS_PER_S, TICK_S, US_PER_S
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.fields import ProfileModel, validated
from airl_mav.core.files import read_json, write_json
from airl_mav.core.kernels import cache_folder
from airl_mav.envs.arena_batch import ArenaBatch, empty_batch
from airl_mav.envs.fleet import Fleet, FleetConstants, Rules, hover, new_fleet, vehicle_of
from airl_mav.envs.fleet_step import advance
from airl_mav.envs.spec import Delay, EnvironmentSpec
from airl_mav.latency.injection import Injection, choose_injection, longest_ms, parse_latency
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import profile_digest
from airl_mav.profiles.vehicle import Payload, VehicleProfile, equipped

SCHEMA = 1
"""Version of the stored measurement."""

SPEEDS = 24
"""Number of commanded speeds, evenly spaced up to the autopilot's maximum."""

MOMENTS_S = tuple(float(each) for each in np.arange(0.25, 8.01, 0.25))
"""Times after the start from hover at which stops are tested [s]. The velocity loop overshoots its
setpoint by 3 % after three seconds and settles within twenty: the maximum speed and distance over
these times count."""

ALTITUDE_M = 2.5

FAR_M = 1e6
"""Distance of walls and goal [m]; beyond reach, so that only intended events end a flight."""

RULES = Rules(goal_radius=1.0, time_limit_us=1 << 60)
"""End conditions of test flights: collision only."""

_STEP_TICKS = 5
"""Sampling interval of the position while braking; 20 ms from its turning point the vehicle is less
than a millimetre away."""

_LONGEST_STOP_S = 60.0


class Braking(ProfileModel):
    """Stopping distance of a vehicle over commanded speed: n speeds, ascending.

    Stops start at the worst time since the start of the flight.
    """

    vehicle_sha256: str
    """Digest of the vehicle with payload and computer."""
    commanded_m_s: tuple[float, ...]
    """Speed of the setpoint [m/s]."""
    flown_m_s: tuple[float, ...]
    """Maximum speed reached with the setpoint [m/s]."""
    distance_m: tuple[float, ...]
    """Maximum distance from the zero velocity setpoint to the stop [m]."""

    @property
    def fastest_m_s(self) -> float:
        """Maximum commanded speed [m/s]; the autopilot's limit."""
        return self.commanded_m_s[-1]

    def stopping_m(self, commanded_m_s: float, reaction_s: float) -> float:
        """Return the stopping distance including a reaction time [m].

        Args:
            commanded_m_s: Speed of the setpoint before the stop, 0 to `fastest_m_s` [m/s].
            reaction_s: Time before the vehicle starts to brake [s].
        """
        flown, distance = self._curves
        return float(flown(commanded_m_s) * reaction_s + distance(commanded_m_s))

    def safe_velocity(self, reaction_s: float, room_m: float) -> float:
        """Return the maximum commanded speed with a stop within a distance [m/s].

        At most `fastest_m_s`.

        Args:
            reaction_s: Time before the vehicle starts to brake, >= 0 [s].
            room_m: Available distance, > 0 [m].
        """
        top = self.fastest_m_s
        if self.stopping_m(top, reaction_s) <= room_m:
            return top
        found = scipy.optimize.brentq(lambda v: self.stopping_m(v, reaction_s) - room_m, 0.0, top)
        return float(found)

    def distance_from_m(self, speed_m_s: float) -> float:
        """Return the stopping distance from a true speed [m]; as v² beyond the measurement."""
        flown, distance = np.array([0.0, *self.flown_m_s]), np.array([0.0, *self.distance_m])
        # The kinetic energy grows with v².
        beyond = max(1.0, speed_m_s / float(flown[-1])) ** 2
        return float(np.interp(speed_m_s, flown, distance)) * beyond

    @property
    def _curves(
        self,
    ) -> tuple[scipy.interpolate.PchipInterpolator, scipy.interpolate.PchipInterpolator]:
        # 0 m/s belongs to the curve; PCHIP keeps it monotonic.
        at = np.array([0.0, *self.commanded_m_s])
        return (
            scipy.interpolate.PchipInterpolator(at, [0.0, *self.flown_m_s]),
            scipy.interpolate.PchipInterpolator(at, [0.0, *self.distance_m]),
        )


def braking_of(vehicle: VehicleProfile) -> Braking:
    """Return the stopping distances of a vehicle with payload and computer; measured once, cached.

    The cache is next to the compiled kernels, in a folder for this source and all its imports,
    under the vehicle's digest: payload, computer and parameters are part of the key.
    """
    return _braking(vehicle.model_dump_json())


@cache
def _braking(vehicle_json: str) -> Braking:
    vehicle = VehicleProfile.model_validate_json(vehicle_json)
    folder = cache_folder(__file__)
    if folder is None:
        return measure_braking(vehicle)
    path = folder / f"braking-{profile_digest(vehicle)[:16]}.json"
    # A missing or damaged file is measured again.
    with suppress(UsageError):
        stored = read_json(path, SCHEMA, "braking")
        del stored["schema"]
        return validated(Braking, stored, path)
    measured = measure_braking(vehicle)
    # The cache is optional: a read-only folder must not fail.
    with suppress(OSError):
        write_json(path, {"schema": SCHEMA, **measured.model_dump()})
    return measured


def measure_braking(vehicle: VehicleProfile) -> Braking:
    """Stop a vehicle at all speeds and times; see `Braking`. Takes half a second."""
    shared = gym_constants_of(vehicle)
    top_m_s = shared.gains.vel_max_xy
    speeds = top_m_s * np.arange(1, SPEEDS + 1) / SPEEDS
    fleet = run_ups(shared, speeds, MOMENTS_S)
    shape = (len(MOMENTS_S), SPEEDS)
    flown = np.hypot(fleet.velocity[:, 0], fleet.velocity[:, 1]).reshape(shape).max(axis=0)
    start = fleet.position[:, 0].copy()
    stop(fleet, open_space(len(start)), shared)
    distance = (fleet.position[:, 0] - start).reshape(shape).max(axis=0)
    # Enforce monotonic curves: at the tilt limit they are constant except for noise.
    return Braking(
        vehicle_sha256=profile_digest(vehicle),
        commanded_m_s=tuple(speeds.tolist()),
        flown_m_s=tuple(np.maximum.accumulate(flown).tolist()),
        distance_m=tuple(np.maximum.accumulate(distance).tolist()),
    )


def gym_constants_of(vehicle: VehicleProfile) -> FleetConstants:
    """Return the vectorized simulator's constants of a vehicle, with the vehicle's parameters."""
    return vehicle_of(vehicle, vehicle.flown_parameters().__getitem__)


def open_space(n: int, obstacles: int = 0) -> ArenaBatch:
    """Return n arenas without walls in reach, with capacity for obstacles."""
    batch = empty_batch(n, obstacles, 0, 0)
    # Walls 1 mm high, far away; the goal is behind the vehicle.
    batch.bounds[:] = [-FAR_M, FAR_M, -FAR_M, FAR_M, 1e-3, 0.0]
    batch.goal[:, :2] = [-FAR_M, 0.0]
    batch.n_static[:] = obstacles
    return batch


def run_ups(vehicle: FleetConstants, speeds: ArrayLike, moments_s: Sequence[float]) -> Fleet:
    """Return vehicles during their acceleration north from hover, at several setpoint speeds.

    Args:
        vehicle: Constants of the vehicle.
        speeds: (n,) speeds of the setpoints [m/s].
        moments_s: k times since the start, ascending [s].

    Returns:
        n k vehicles, grouped by time.
    """
    wanted = np.asarray(speeds, np.float64)
    n = len(wanted)
    fleet, arenas = new_fleet(n), open_space(n)
    for i in range(n):
        hover(fleet, i, ALTITUDE_M, vehicle)
    # Forward is north, because the vehicle hovers with heading north.
    fleet.setpoint[:, 0] = wanted
    taken, flown = [], 0
    for moment in moments_s:
        ticks = round(moment / TICK_S)
        advance(fleet, arenas, np.full(n, ticks - flown, np.int64), vehicle, RULES, None)
        flown = ticks
        # A copy: the fleet keeps flying.
        taken.append(Fleet._make(array.copy() for array in fleet))
    return Fleet._make(np.concatenate(arrays) for arrays in zip(*taken, strict=True))


def stop(fleet: Fleet, arenas: ArenaBatch, vehicle: FleetConstants) -> None:
    """Set all setpoints to zero velocity and fly until no vehicle moves north.

    A vehicle remains at its turning point, or at its point of contact.
    """
    fleet.setpoint[:] = 0.0
    # The new setpoint acts at once.
    fleet.repeat_us[:] = fleet.time_us
    moving = np.ones(len(fleet.time_us), np.bool_)
    for _ in range(round(_LONGEST_STOP_S / (_STEP_TICKS * TICK_S))):
        before: NDArray[np.float64] = fleet.position[:, 0].copy()
        advance(fleet, arenas, np.where(moving, _STEP_TICKS, 0), vehicle, RULES, None)
        # The turning point: the vehicle no longer moves north.
        moving &= fleet.position[:, 0] > before
        if not moving.any():
            return


@dataclass(frozen=True)
class DecisionLoop:
    """Timing of a companion's decisions in simulated time, without the inference t2."""

    frame_period_s: float
    transport_s: float
    """Time from capture to decoded frame."""
    hold_s: float
    """Time from sending a setpoint to the next observation."""
    link_s: float
    """Time from sending a setpoint to the motors' response."""

    @classmethod
    def of(cls, vehicle: VehicleProfile, hold_s: float, delay: Delay | None = None) -> DecisionLoop:
        """Return the loop for a vehicle's camera; the default delays are those of level gym."""
        delay = delay or Delay()
        return cls(
            frame_period_s=vehicle.camera.period_us / US_PER_S,
            transport_s=delay.transport_ms / MS_PER_S,
            hold_s=hold_s,
            link_s=delay.link_ms / MS_PER_S,
        )

    def reaction_s(self, t2_s: float) -> float:
        """Return the maximum time from an obstacle's appearance to the motors' response [s].

        T = frame period + transport + t2 + hold + t2 + link, and a tick of the flight controller. A
        decision's newest frame is up to a frame period plus the transport old, and may just miss
        the obstacle. This decision infers and holds; the next one sees the obstacle, infers, and
        sends its setpoint.

        Args:
            t2_s: Maximum inference time [s].
        """
        waited = self.frame_period_s + self.transport_s
        return waited + t2_s + self.hold_s + t2_s + self.link_s + TICK_S

    def inference_s(self, reaction_s: float) -> float:
        """Return the maximum inference time for a reaction time [s]; negative = infeasible."""
        return 0.5 * (reaction_s - self.reaction_s(0.0))


@dataclass(frozen=True)
class StoppingTask:
    """Vehicle with its decision timing and sensing distance."""

    vehicle: VehicleProfile
    """Vehicle with payload and computer."""
    loop: DecisionLoop
    sensing_distance_m: float
    """D: distance from the camera to an obstacle's surface when the policy reacts [m]."""

    @property
    def room_m(self) -> float:
        """Distance to the hull's contact with an obstacle seen at D [m].

        The camera is ahead of the centre of mass by its mount, the hull by half its width.
        """
        body, camera = self.vehicle.body, self.vehicle.camera
        return self.sensing_distance_m + camera.forward_m - 0.5 * body.width_m

    def safe_velocity(self, t2_s: float) -> float:
        """Return the maximum speed with v T + brake(v) <= D minus the hull's overhang [m/s].

        At most the autopilot's maximum speed.

        Args:
            t2_s: Maximum inference time [s].

        Raises:
            FieldError: The sensing distance ends within the hull.
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
        """Return the maximum inference time at which a speed is safe [s]; negative = infeasible.

        Args:
            speed_m_s: Speed of the setpoint, > 0 and at most the autopilot's maximum [m/s].
        """
        braking = braking_of(self.vehicle)
        braked_m = braking.stopping_m(speed_m_s, 0.0)
        # stopping_m(v, 1) - stopping_m(v, 0) is the speed flown at this setpoint.
        flown_m_s = braking.stopping_m(speed_m_s, 1.0) - braked_m
        return self.loop.inference_s((self.room_m - braked_m) / flown_m_s)


@dataclass(frozen=True)
class SpeedBound:
    """The safe velocity of an environment, and its inputs."""

    reaction_s: float
    """T: worst-case time from an obstacle's appearance to the motors' response [s]."""
    sensing_distance_m: float
    safe_velocity_m_s: float
    asked_m_s: float
    """Speed of the fastest action without the bound [m/s]."""

    @property
    def max_speed_m_s(self) -> float:
        """Speed of the fastest action [m/s]."""
        return min(self.asked_m_s, self.safe_velocity_m_s)

    def describe(self) -> str:
        """Return the bound in one line."""
        facts = (
            f"safe velocity {self.safe_velocity_m_s:.2f} m/s (reaction {self.reaction_s:.3f} s, "
            f"sensing distance {self.sensing_distance_m:g} m, braking as measured)"
        )
        if self.safe_velocity_m_s < self.asked_m_s:
            share = self.max_speed_m_s / self.asked_m_s
            return f"{facts}: actions scaled by {share:.3f}, from {self.asked_m_s:g} m/s"
        return f"{facts}: above the fastest action, {self.asked_m_s:g} m/s: actions are not scaled"


def injections_of(delay: Delay) -> tuple[Injection, ...]:
    """Return the sources of t2. Raises UsageError for an invalid source."""
    if delay.latency:
        option = "environment.delay.latency"
        return tuple(parse_latency(source, option) for source in delay.latency)
    return (choose_injection(load_computer(delay.computer), delay.workload),)


def speed_bound(spec: EnvironmentSpec) -> SpeedBound | None:
    """Return the safe velocity of an environment; None if it has no bound.

    Uses the maximum latency of all sources and the profile's vehicle, as in the environment.

    Raises:
        UsageError: A profile or a source of latency is invalid, or the sensing distance ends within
            the hull.
    """
    asked, delay = spec.safe_velocity, spec.delay
    if asked is None:
        return None
    t2_ms = max(
        delay.native_ms if source.latency is None else longest_ms(source.latency)
        for source in injections_of(delay)
    )
    low_high = spec.randomisation.extra_delay_ms
    # The worst case: the maximum of the random extra delay.
    t2_s = (t2_ms + low_high[1]) / MS_PER_S
    vehicle, _ = equipped(spec.vehicle, delay.computer, Payload())
    loop = DecisionLoop.of(vehicle, spec.episode.hold_s, delay)
    return SpeedBound(
        reaction_s=loop.reaction_s(t2_s),
        sensing_distance_m=asked.sensing_distance_m,
        safe_velocity_m_s=StoppingTask(vehicle, loop, asked.sensing_distance_m).safe_velocity(t2_s),
        asked_m_s=spec.max_speed_m_s,
    )


def bounded(spec: EnvironmentSpec) -> EnvironmentSpec:
    """Return an environment with its actions bounded by its safe velocity, if it has one.

    Idempotent. Raises UsageError as `speed_bound`.
    """
    bound = speed_bound(spec)
    if bound is None or bound.max_speed_m_s == spec.max_speed_m_s:
        return spec
    return spec.model_copy(update={"max_speed_m_s": bound.max_speed_m_s})
