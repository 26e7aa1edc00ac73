"""One vehicle in one arena, tick by tick: plant, autopilot and what is recorded of them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame
from airl_mav.core.clock import Clock
from airl_mav.core.files import save_arrays
from airl_mav.flight.trajectory import TrajectoryRecorder
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.model import Aircraft
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.filters import filter_named
from firmware_sim.autopilot.parameters import Parameters
from firmware_sim.autopilot.state import Estimate, Setpoint
from firmware_sim.flight_controller import FlightController
from firmware_sim.interfaces import SensorSample, Truth
from firmware_sim.plant.camera_server import DepthCamera
from firmware_sim.plant.kinematics import POSE, POSITION, QUATERNION
from firmware_sim.plant.plant import Plant

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
    aircraft: Aircraft = field(default_factory=Aircraft)
    """What was asked of it: wind, estimator."""


class SetpointLog:
    """When each offboard setpoint was accepted, and when the motors first reflected it."""

    def __init__(self) -> None:
        self._accepted: list[tuple[int, tuple[float, float, float, float]]] = []
        self._motor_us: list[int] = []
        self._under_way: list[list[int]] = []
        """How many setpoints were taken in a tick, and after how many more they are flown."""
        self._taken = 0

    @property
    def fresh(self) -> bool:
        """Whether setpoints were accepted that no tick has taken yet."""
        return len(self._accepted) > self._taken

    @property
    def pending(self) -> bool:
        """Whether setpoints were accepted that no motor commands reflect yet."""
        return len(self._accepted) > len(self._motor_us)

    def accepted(self, setpoint: Setpoint, time_us: int) -> None:
        """Note an accepted setpoint and when it was received [µs]."""
        self._accepted.append((time_us, setpoint.wire))

    def take(self, ticks_to_motors: int) -> None:
        """Note that the coming tick takes what was accepted, to be flown so many ticks later."""
        self._under_way.append([len(self._accepted) - self._taken, ticks_to_motors])
        self._taken = len(self._accepted)

    def ticked(self, time_us: int) -> None:
        """Note that motor commands were computed, at `time_us` [µs]."""
        for entry in self._under_way:
            if entry[1] <= 0:
                self._motor_us.extend([time_us] * entry[0])
            entry[1] -= 1
        self._under_way = [entry for entry in self._under_way if entry[1] >= 0]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return accepted_us (n,), motor_us (n,), setpoint float32 (n, 4)."""
        n = len(self._motor_us)
        return {
            "accepted_us": np.array([t for t, _ in self._accepted[:n]], np.int64),
            "motor_us": np.array(self._motor_us, np.int64),
            "setpoint": np.array([v for _, v in self._accepted[:n]], np.float32).reshape(n, 4),
        }


def builtin_autopilot(setup: EpisodeSetup) -> BuiltinAutopilot:
    """Boot the built-in autopilot. Raises UsageError for a wrong parameter of the vehicle's."""
    parameters = Parameters(setup.vehicle.autopilot_parameters())
    return BuiltinAutopilot(parameters, filter_named(setup.aircraft.estimator))


class Simulation:
    """Plant and autopilot of one episode. Knows nothing of MAVLink, sockets or pacing."""

    def __init__(
        self,
        setup: EpisodeSetup,
        *,
        start_us: int,
        clock: Clock,
        autopilot: FlightController | None = None,
    ) -> None:
        """Put the vehicle at the start.

        Args:
            setup: Vehicle, arena, seed, and what was asked of the aircraft.
            start_us: Simulated time of the first sample [µs], a multiple of the tick.
            clock: Read for stamps only; time moves by `tick`.
            autopilot: Who flies, just booted; None = the built-in autopilot, booted here.

        Raises:
            UsageError: The vehicle's parameter overrides are wrong.
        """
        rng = np.random.default_rng(setup.seed)
        self.autopilot: FlightController = autopilot or builtin_autopilot(setup)
        self.plant = Plant(
            setup.vehicle,
            setup.arena,
            rng,
            start_us=start_us,
            aircraft=setup.aircraft,
            rate_hz=self.autopilot.rate_hz,
        )
        self.autopilot.see(self.plant.truth)
        self._arena = setup.arena
        self._camera: DepthCamera | None = None
        self._capture_us = NEVER_US
        if setup.arena is not None:
            self._camera = DepthCamera.from_profile(setup.vehicle.camera, setup.arena)
            self._camera.reset(setup.arena, start_us)
            self._capture_us = self._camera.next_us
        self.setpoints = SetpointLog()
        self._inside = self.autopilot.inside
        if self._inside is not None:
            self._inside.on_setpoint = self.setpoints.accepted
        self.start_us = start_us
        self.time_us = start_us
        """Simulated time of the newest sample."""
        self._clock = clock
        self._trajectory = TrajectoryRecorder()
        self._estimates: list[Estimate] = []
        """As old as the samples of the trajectory, less one tick: what the motors were told by."""
        self._sample: SensorSample = self.plant.sense()

    def begin(self) -> None:
        """Say that the episode begins now: what was flown and recorded so far is no part of it."""
        self.start_us = self.time_us
        self._trajectory = TrajectoryRecorder()
        self._estimates = []
        self.plant.begin()
        if self._camera is not None and self._arena is not None:
            self._camera.reset(self._arena, self.start_us)
            self._capture_us = self._camera.next_us

    @property
    def truth(self) -> Truth:
        """The true state now; made anew at every call."""
        return self.plant.truth()

    def tick(self) -> None:
        """Run autopilot, then plant, for one tick."""
        plant = self.plant
        setpoints = self.setpoints
        if self._inside is not None and setpoints.fresh:
            setpoints.take(self._inside.ticks_to_motors)
        controls = self.autopilot.step(self._sample)
        if setpoints.pending:
            setpoints.ticked(self._clock.time_us())
        self._sample = plant.step(controls)
        self.time_us = plant.time_us
        if self._trajectory.integrate(self.time_us, plant.power_w):
            self._trajectory.keep(plant.motion[POSE])
            if self._inside is not None:
                self._estimates.append(self._inside.estimator.estimate())

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
        arrays = {f"trajectory/{name}": values for name, values in trajectory.items()}
        return arrays if self._inside is None else {**arrays, **self._inner_arrays()}

    def _inner_arrays(self) -> dict[str, NDArray[Any]]:
        """Return what only an autopilot with an open inside shows."""
        estimates = self._estimates
        return {
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
        """Release the physics server and the autopilot."""
        self.plant.close()
        self.autopilot.close()
