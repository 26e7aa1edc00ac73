"""One vehicle in one arena, tick by tick: plant, autopilot and what is recorded of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.atomic import save_arrays
from airl_mav.camera.frame import Frame
from airl_mav.clock import Clock
from airl_mav.constants import TICK_US
from airl_mav.flight.trajectory import TrajectoryRecorder
from airl_mav.profiles.vehicle import VehicleProfile
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.parameters import Parameters
from firmware_sim.autopilot.state import AutopilotState, Setpoint
from firmware_sim.interfaces import SensorSample
from firmware_sim.plant.camera_server import DepthCamera
from firmware_sim.plant.plant import Plant, Truth
from firmware_sim.plant.wind import WindSettings

ESTIMATE_EVERY = 5
"""The estimate is recorded every so many ticks: 50 Hz."""


@dataclass(frozen=True)
class EpisodeSetup:
    """What an episode is made of."""

    vehicle: VehicleProfile
    arena: Arena | None
    """None = an endless floor."""
    seed: int
    """Of sensors and wind."""
    wind: WindSettings


class SetpointLog:
    """When each offboard setpoint was accepted, and when the motors first reflected it."""

    def __init__(self) -> None:
        self._accepted: list[tuple[int, tuple[float, float, float, float]]] = []
        self._motor_us: list[int] = []

    def accepted(self, setpoint: Setpoint, time_us: int) -> None:
        """Note an accepted setpoint and when it was received [µs]."""
        self._accepted.append((time_us, setpoint.wire))

    def applied(self, time_us: int) -> None:
        """Note that motor commands were computed: all accepted setpoints are in them."""
        missing = len(self._accepted) - len(self._motor_us)
        self._motor_us.extend([time_us] * missing)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return accepted_us (n,), motor_us (n,), setpoint float32 (n, 4)."""
        n = len(self._motor_us)
        return {
            "accepted_us": np.array([t for t, _ in self._accepted[:n]], np.int64),
            "motor_us": np.array(self._motor_us, np.int64),
            "setpoint": np.array([v for _, v in self._accepted[:n]], np.float32).reshape(n, 4),
        }


class Simulation:
    """Plant and autopilot of one episode. Knows nothing of MAVLink, sockets or pacing."""

    def __init__(self, setup: EpisodeSetup, *, start_us: int, clock: Clock) -> None:
        """Put the vehicle at the start and boot the autopilot.

        Args:
            setup: Vehicle, arena, seed, wind.
            start_us: Simulated time of the first sample [µs], a multiple of the tick.
            clock: Read for stamps only; time moves by `tick`.

        Raises:
            UsageError: The vehicle's parameter overrides are wrong.
        """
        rng = np.random.default_rng(setup.seed)
        self.autopilot = BuiltinAutopilot(Parameters(setup.vehicle.parameters))
        self.plant = Plant(setup.vehicle, setup.arena, rng, start_us=start_us, wind=setup.wind)
        self._camera: DepthCamera | None = None
        if setup.arena is not None:
            self._camera = DepthCamera.from_profile(setup.vehicle.camera, setup.arena)
            self._camera.reset(setup.arena, start_us)
        self.setpoints = SetpointLog()
        self.autopilot.on_setpoint = self.setpoints.accepted
        self.start_us = start_us
        self.time_us = start_us
        """Simulated time of the newest sample."""
        self._clock = clock
        self._arena = setup.arena
        self._trajectory = TrajectoryRecorder()
        self._estimates: list[tuple[float, ...]] = []
        self._ticks = 0
        self._sample: SensorSample = self.plant.sense()
        self.truth: Truth = self.plant.truth()

    def tick(self) -> None:
        """Run autopilot, then plant, for one tick."""
        controls = self.autopilot.step(self._sample)
        self.setpoints.applied(self._clock.time_us())
        self._sample = self.plant.step(controls)
        self.time_us += TICK_US
        truth = self.truth = self.plant.truth()
        self._trajectory.add(
            truth.time_us, truth.position, truth.velocity, truth.quaternion, truth.power_w
        )
        if self._ticks % ESTIMATE_EVERY == 0:
            self._record_estimate(self.autopilot.state())
        self._ticks += 1

    def capture_due(self, publish: Callable[[Frame], None]) -> None:
        """Hand a depth frame to `publish` when the camera is due; an endless floor has none."""
        camera, arena, truth = self._camera, self._arena, self.truth
        if camera is None or arena is None or not camera.due(self.time_us):
            return
        centers = arena.centers_at(self.time_us - self.start_us)
        publish(camera.capture(self.time_us, truth.position, truth.quaternion, centers))

    def _record_estimate(self, state: AutopilotState) -> None:
        e = state.estimate
        self._estimates.append((e.time_us, *e.position, *e.velocity, *e.quaternion))

    def save(self, path: Path, extra: dict[str, NDArray[Any]]) -> None:
        """Write the episode's arrays, and `extra` ones, to an .npz."""
        estimates = np.array(self._estimates, np.float64).reshape(-1, 11)
        arrays: dict[str, Any] = {
            f"trajectory/{k}": v for k, v in self._trajectory.trajectory().arrays().items()
        }
        arrays |= {f"setpoints/{k}": v for k, v in self.setpoints.arrays().items()}
        arrays |= {
            "estimate/time_us": estimates[:, 0].astype(np.int64),
            "estimate/position": estimates[:, 1:4],
            "estimate/velocity": estimates[:, 4:7],
            "estimate/quaternion": estimates[:, 7:11],
        }
        arrays |= extra
        save_arrays(path, arrays)

    def close(self) -> None:
        """Release the physics server."""
        self.plant.close()
