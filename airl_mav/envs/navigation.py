"""N flights at a time: the companion's decision loop around the batch twin.

A decision, as `companion.pilot` flies it: the frame was taken a moment ago, the state is that of
now; while the network computes, and until its setpoint arrives, the last one keeps flying; then
the action is held. Everything is in ticks of simulated time, so nothing depends on the machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.arena.zones import zone_radius_m
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import Mount
from airl_mav.constants import TICK_US, US_PER_S
from airl_mav.envs.arenas import batch_of, put_arena
from airl_mav.envs.camera import lens_of, look
from airl_mav.envs.draws import DelayDraws, NormalDraws, Stream, stream
from airl_mav.envs.fleet import Rules, Verdict, advance, hover, new_fleet, vehicle_of
from airl_mav.envs.randomise import draw_airframe, noisy_depth
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.errors import UsageError
from airl_mav.latency.injection import Injection, choose_injection
from airl_mav.policy.actions import vertical_speeds
from airl_mav.policy.layouts import (
    Encoded,
    ObservationSpec,
    camera_mismatch,
    encode_layout,
)
from airl_mav.policy.observation import Kinematics, observe
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.computer import load_computer
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.parameters import parameter_values
from airl_mav.profiles.vehicle import Camera, VehicleProfile, load_vehicle

US_PER_MS = 1000


@dataclass(frozen=True)
class Flights:
    """How n flights stand; arrays (n,)."""

    verdict: NDArray[np.int64]
    """`fleet.Verdict`."""
    time_s: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    """Flown so far [m]."""
    energy_j: NDArray[np.float64]
    goal_distance_m: NDArray[np.float64]
    """Horizontal, true."""
    speed_m_s: NDArray[np.float64]
    """Three-dimensional, true."""


class Navigation:
    """N vehicles, each flying to its goal. Slots are begun and flown; nothing resets by itself."""

    def __init__(self, spec: EnvironmentSpec, n: int) -> None:
        """Load what the environment is made of.

        Raises:
            UsageError: A profile cannot be used, or the camera does not serve the layout.
        """
        self.spec = spec
        self.n = n
        self.vehicle: VehicleProfile = load_vehicle(spec.vehicle)
        self.arena_spec: ArenaSpec = load_profile("arenas", spec.arena, ArenaSpec)
        self.camera: Camera = self.vehicle.camera.model_copy(
            update=spec.camera.model_dump(exclude_none=True)
        )
        self.observation = ObservationSpec(
            layout=spec.layout,
            height_px=spec.image_height_px,
            width_px=spec.image_width_px,
            horizontal_fov_deg=self.camera.horizontal_fov_deg,
            range_m=self.camera.range_m,
        )
        self.intrinsics: Intrinsics = self.camera.intrinsics
        if problem := camera_mismatch(self.observation, self.intrinsics):
            raise UsageError(f"image_width_px, image_height_px: {problem}")
        self.injection: Injection = choose_injection(
            load_computer(spec.delay.computer), spec.delay.workload
        )
        parameters = parameter_values(self.vehicle.parameters)
        self._vehicle = vehicle_of(self.vehicle, parameters.__getitem__)
        self._mount = Mount(
            (self.camera.forward_m, 0.0, -self.camera.up_m), np.deg2rad(self.camera.pitch_up_deg)
        )
        self._lens = lens_of(self.intrinsics, self.camera.range_m)
        rules = spec.episode
        self._rules = Rules(rules.goal_radius_m, round(rules.time_limit_s * US_PER_S))
        self._hold_us = round(rules.hold_s * US_PER_S)
        self._transport_us = round(spec.delay.transport_ms * US_PER_MS)
        self._link_us = round(spec.delay.link_ms * US_PER_MS)

        self.arenas: list[Arena | None] = [None] * n
        self.seeds = np.zeros(n, np.int64)
        self.zones = np.full(n, -1, np.int64)
        self._fleet = new_fleet(n)
        self._batch = batch_of([])
        self._decision = np.zeros(n, np.int64)
        self._frame_us = np.zeros(n, np.int64)
        self._extra_us = np.zeros(n, np.int64)
        self._delays = DelayDraws(n, self.injection, round(spec.delay.native_ms * US_PER_MS))
        self._normals = NormalDraws(n)
        self._depth_rngs: list[np.random.Generator | None] = [None] * n
        self._image = np.zeros((n, self.intrinsics.height, self.intrinsics.width), np.uint16)

    def begin(self, slots: Sequence[int], seeds: Sequence[int], zone: int | None = None) -> None:
        """Start episodes: each in a hover above its start, the first frame taken.

        Args:
            slots: Which of the n.
            seeds: Of the episodes, one a slot.
            zone: Curriculum zone that bounds the goals; None is the largest.

        Raises:
            UsageError: No arena can be made of a seed, or there is no such zone.
        """
        zone_radius_m(self.arena_spec, zone)
        who = np.zeros(self.n, np.bool_)
        for i, seed in zip(slots, seeds, strict=True):
            self._begin(i, int(seed), zone)
            who[i] = True
        self._look(who)

    def _begin(self, i: int, seed: int, zone: int | None) -> None:
        arena = generate(
            self.arena_spec,
            seed,
            name=Path(self.spec.arena).stem,
            vehicle_width_m=self.vehicle.body.width_m,
            zone=zone,
        )
        self.arenas[i], self.seeds[i], self.zones[i] = arena, seed, -1 if zone is None else zone
        try:
            put_arena(self._batch, i, arena)
        except (ValueError, IndexError):
            # More room: at the start, and when an arena comes that is fuller than all before.
            self._batch = batch_of([a if a is not None else arena for a in self.arenas])
        randomisation = self.spec.randomisation
        airframe = draw_airframe(
            self._vehicle.airframe, randomisation, stream(seed, Stream.AIRFRAME)
        )
        hover(self._fleet, i, self.spec.episode.altitude_m, self._vehicle, airframe)
        self._decision[i] = 0
        # Frames come at the camera's rate, at any phase of the decisions.
        phase = stream(seed, Stream.CAMERA).random()
        self._frame_us[i] = -int(phase * self.camera.period_us)
        low, high = randomisation.extra_delay_ms
        delay_rng = stream(seed, Stream.DELAY)
        self._extra_us[i] = round(delay_rng.uniform(low, high) * US_PER_MS)
        self._delays.begin(i, seed)
        self._normals.begin(i, seed)
        self._depth_rngs[i] = stream(seed, Stream.DEPTH)

    def observe(self) -> Encoded:
        """Return what all n policies see now, in the environment's layout."""
        seen = observe(self._image, self.intrinsics, self.kinematics(), self._batch.goal)
        return encode_layout(self.observation, seen)

    def kinematics(self) -> Kinematics:
        """Return the state of all n as telemetry reports it."""
        fleet = self._fleet
        return Kinematics(fleet.position, fleet.velocity, fleet.quaternion)

    def flights(self) -> Flights:
        """Return how all n flights stand."""
        fleet = self._fleet
        to_goal = self._batch.goal - fleet.position[:, :2]
        return Flights(
            verdict=fleet.verdict.copy(),
            time_s=fleet.time_us / US_PER_S,
            distance_m=fleet.distance.copy(),
            energy_j=fleet.energy.copy(),
            goal_distance_m=np.hypot(to_goal[:, 0], to_goal[:, 1]),
            speed_m_s=np.linalg.norm(fleet.velocity, axis=1),
        )

    def fly(self, commands: NDArray[np.float64]) -> None:
        """Fly one decision of every flight that goes on.

        Args:
            commands: (n, 3) forward, right [m/s], yaw rate [rad/s].
        """
        delay_us = self._delays.take(self._decision) + self._extra_us + self._link_us
        self._compute(_ticks(delay_us))
        self._command(commands)
        # What is left of the hold once the delays are rounded to ticks stays with the hold.
        end_us = self._fleet.time_us + self._hold_us
        age = np.minimum(_ticks(self._age_us(end_us)), self._hold_us // TICK_US)
        self._advance(self._hold_us // TICK_US - age)
        self._look(self._fleet.verdict >= 0)
        self._advance(age)
        self._decision += 1

    def _compute(self, ticks: NDArray[np.int64]) -> None:
        """Fly on the last setpoint, or stop after a while, while the next one is computed."""
        hover_s = self.spec.episode.hover_after_s
        if hover_s is None:
            self._advance(ticks)
            return
        first = np.minimum(ticks, round(hover_s * US_PER_S) // TICK_US)
        self._advance(first)
        late = ticks > first
        self._fleet.setpoint[late] = 0.0
        self._fleet.repeat_us[late] = self._fleet.time_us[late]
        self._advance(ticks - first)

    def _command(self, commands: NDArray[np.float64]) -> None:
        fleet = self._fleet
        down = vertical_speeds(self.spec.episode.altitude_m, self.kinematics().position[:, 2])
        fleet.setpoint[:, :2] = commands[:, :2]
        fleet.setpoint[:, 2] = down
        fleet.setpoint[:, 3] = commands[:, 2]
        fleet.repeat_us[:] = fleet.time_us

    def _age_us(self, time_us: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return how old the newest decoded frame is at a time (n,) [µs]."""
        age: NDArray[np.int64] = self._transport_us + (
            (time_us - self._transport_us - self._frame_us) % self.camera.period_us
        )
        return age

    def _advance(self, ticks: NDArray[np.int64]) -> None:
        advance(self._fleet, self._batch, ticks, self._vehicle, self._rules)

    def _look(self, who: NDArray[np.bool_]) -> None:
        look(self._fleet, self._batch, who, self._mount, self._lens, self._image)
        if self.spec.randomisation.depth_noise or self.spec.randomisation.depth_dropout:
            for i in np.flatnonzero(who):
                rng = self._depth_rngs[i]
                if rng is not None:
                    self._image[i] = noisy_depth(self._image[i], self.spec.randomisation, rng)


def _ticks(time_us: NDArray[np.int64]) -> NDArray[np.int64]:
    """Round times [µs] to whole ticks."""
    ticks: NDArray[np.int64] = (time_us + TICK_US // 2) // TICK_US
    return ticks


def outcome_counts(verdict: NDArray[np.int64]) -> dict[str, int]:
    """Return how many flights ended how, by the verdict's name in lower case."""
    return {v.name.lower(): int(np.count_nonzero(verdict == v)) for v in Verdict}
