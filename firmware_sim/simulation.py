"""One vehicle in one arena, tick by tick: plant, autopilot and what is recorded of them."""

from __future__ import annotations

import sys
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
from firmware_sim.autopilot.filters import FilterName, filter_named
from firmware_sim.autopilot.parameters import Parameters
from firmware_sim.autopilot.state import Estimate, Setpoint
from firmware_sim.interfaces import SensorSample
from firmware_sim.plant.camera_server import DepthCamera
from firmware_sim.plant.kinematics import POSE, POSITION, QUATERNION
from firmware_sim.plant.plant import Plant, Truth
from firmware_sim.plant.wind import WindSettings

NEVER_US = sys.maxsize
"""Later than any simulated time [µs]."""


@dataclass(frozen=True)
class EpisodeSetup:
    """What an episode is made of."""

    vehicle: VehicleProfile
    arena: Arena | None
    """None = an endless floor."""
    seed: int
    """Of sensors and wind."""
    wind: WindSettings
    filter: FilterName = "kernel"
    """What carries the estimator's covariance."""


class SetpointLog:
    """When each offboard setpoint was accepted, and when the motors first reflected it."""

    def __init__(self) -> None:
        self._accepted: list[tuple[int, tuple[float, float, float, float]]] = []
        self._motor_us: list[int] = []
        self.pending = False
        """Setpoints were accepted that no motor commands reflect yet."""

    def accepted(self, setpoint: Setpoint, time_us: int) -> None:
        """Note an accepted setpoint and when it was received [µs]."""
        self._accepted.append((time_us, setpoint.wire))
        self.pending = True

    def applied(self, time_us: int) -> None:
        """Note that motor commands were computed: all accepted setpoints are in them."""
        missing = len(self._accepted) - len(self._motor_us)
        self._motor_us.extend([time_us] * missing)
        self.pending = False

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
        self.autopilot = BuiltinAutopilot(
            Parameters(setup.vehicle.parameters), filter_named(setup.filter)
        )
        self.plant = Plant(setup.vehicle, setup.arena, rng, start_us=start_us, wind=setup.wind)
        self._arena = setup.arena
        self._camera: DepthCamera | None = None
        self._capture_us = NEVER_US
        if setup.arena is not None:
            self._camera = DepthCamera.from_profile(setup.vehicle.camera, setup.arena)
            self._camera.reset(setup.arena, start_us)
            self._capture_us = self._camera.next_us
        self.setpoints = SetpointLog()
        self.autopilot.on_setpoint = self.setpoints.accepted
        self.start_us = start_us
        self.time_us = start_us
        """Simulated time of the newest sample."""
        self._clock = clock
        self._trajectory = TrajectoryRecorder()
        self._estimates: list[Estimate] = []
        """As old as the samples of the trajectory, less one tick: what the motors were told by."""
        self._sample: SensorSample = self.plant.sense()

    @property
    def truth(self) -> Truth:
        """The true state now; made anew at every call."""
        return self.plant.truth()

    def tick(self) -> None:
        """Run autopilot, then plant, for one tick."""
        plant = self.plant
        controls = self.autopilot.step(self._sample)
        if self.setpoints.pending:
            self.setpoints.applied(self._clock.time_us())
        self._sample = plant.step(controls)
        self.time_us += TICK_US
        if self._trajectory.integrate(self.time_us, plant.power_w):
            self._trajectory.keep(plant.motion[POSE])
            self._estimates.append(self.autopilot.estimator.estimate())

    def capture_due(self, publish: Callable[[Frame], None]) -> None:
        """Hand a depth frame to `publish` when the camera is due; an endless floor has none."""
        if self.time_us >= self._capture_us:
            self._capture(publish)

    def _capture(self, publish: Callable[[Frame], None]) -> None:
        camera, arena, motion = self._camera, self._arena, self.plant.motion
        if camera is None or arena is None:
            return
        centers = arena.centers_at(self.time_us - self.start_us)
        publish(camera.capture(self.time_us, motion[POSITION], motion[QUATERNION], centers))
        self._capture_us = camera.next_us

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what was recorded so far, by the names of its file (docs/run-folder.md)."""
        trajectory = self._trajectory.trajectory().arrays()
        estimates = self._estimates
        return {
            **{f"trajectory/{name}": values for name, values in trajectory.items()},
            **{f"setpoints/{name}": values for name, values in self.setpoints.arrays().items()},
            "estimate/time_us": np.array([e.time_us for e in estimates], np.int64),
            "estimate/position": np.array([e.position for e in estimates]).reshape(-1, 3),
            "estimate/velocity": np.array([e.velocity for e in estimates]).reshape(-1, 3),
            "estimate/quaternion": np.array([e.quaternion for e in estimates]).reshape(-1, 4),
        }

    def save(self, path: Path, extra: dict[str, NDArray[Any]]) -> None:
        """Write the episode's arrays, and `extra` ones, to an .npz."""
        save_arrays(path, {**self.arrays(), **extra})

    def close(self) -> None:
        """Release the physics server."""
        self.plant.close()
