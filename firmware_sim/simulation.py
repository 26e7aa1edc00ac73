"""One vehicle in one arena, tick by tick: plant, autopilot and what is recorded of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame
from airl_mav.camera.render import Motion
from airl_mav.core.clock import Clock
from airl_mav.core.streams import Stream, stream
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.vehicle.airframe import Airframe
from airl_mav.vehicle.spread import draw_airframe
from airl_mav.vehicle.wind import wind_of_episode
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.parameter_store import Keeper, Parameters
from firmware_sim.faults.camera import FailingCamera
from firmware_sim.faults.controller import FailingParts
from firmware_sim.faults.injection import ClientFaults
from firmware_sim.faults.timeline import FaultTimeline
from firmware_sim.flight_controller import FlightController
from firmware_sim.hover_start import HoverStart
from firmware_sim.interfaces import ActuatorControls, SensorSample, Truth
from firmware_sim.plant.camera_server import SimulatedCamera
from firmware_sim.plant.kinematics import POSITION, QUATERNION, RATES, VELOCITY
from firmware_sim.plant.onboard_camera import CameraMaker, OnboardCamera
from firmware_sim.plant.plant import Plant
from firmware_sim.recording import FlightRecorder, fault_arrays
from firmware_sim.simulation_snapshot import SimulationSnapshot


@dataclass(frozen=True)
class EpisodeSetup:
    """What an episode is made of."""

    vehicle: VehicleProfile
    arena: Arena | None
    """None = an endless floor."""
    seed: int
    """Of sensors, wind, and what is drawn of the aircraft."""
    aircraft: Aircraft = field(default_factory=Aircraft)
    """What was asked of it: wind, spread, sensors, estimator, charge of the battery."""
    computer_w: float = 0.0
    """What the onboard computer draws from the pack [W]."""
    hover: HoverStart | None = None
    """How the episode begins in a hover; None = on the ground."""


def builtin_autopilot(setup: EpisodeSetup, keeper: Keeper | None = None) -> BuiltinAutopilot:
    """Boot the built-in autopilot.

    `keeper` keeps the parameters that users set. Raises UsageError for a wrong parameter of the
    vehicle's, or when what is kept cannot be read.
    """
    overrides = dict(setup.vehicle.autopilot_parameters())
    if instance := setup.aircraft.real.instance:
        overrides["MAV_SYS_ID"] = instance + 1  # as PX4 SITL's rcS sets it
    parameters = Parameters(overrides, keeper)
    if setup.aircraft.estimator == "kernel":
        return BuiltinAutopilot(parameters)
    # The library's filter, equal to rounding. Imported late: it brings scipy's statistics along.
    from firmware_sim.autopilot.filter_filterpy import FilterpyFilter

    return BuiltinAutopilot(parameters, FilterpyFilter)


class Simulation:
    """Plant and autopilot of one episode. Knows nothing of MAVLink, sockets or pacing."""

    def __init__(
        self,
        setup: EpisodeSetup,
        *,
        start_us: int,
        clock: Clock,
        autopilot: FlightController | None = None,
        recording: bool = True,
        read_by: Callable[[int], int] | None = None,
        camera_by: CameraMaker = SimulatedCamera,
    ) -> None:
        """Put the vehicle at the start.

        Args:
            setup: Vehicle, arena, seed, and what was asked of the aircraft.
            start_us: Simulated time of the first sample [µs], a multiple of the tick.
            clock: Read for stamps only; time moves by `tick`.
            autopilot: Who flies, just booted; None = the built-in autopilot, booted here.
            recording: Whether the flight is recorded; if not, it may go on for ever.
            read_by: Tells of what was read from a time on [µs] by when it had arrived [µs], for
                the record; None = no time passes while it is read.
            camera_by: Makes the camera.

        Raises:
            UsageError: The vehicle's parameter overrides are wrong.
        """
        asked, nominal = setup.aircraft, Airframe.from_profile(setup.vehicle)
        wind = wind_of_episode(asked.wind, setup.seed)
        self.autopilot: FlightController = autopilot or builtin_autopilot(setup)
        self.plant = Plant(
            setup.vehicle,
            setup.arena,
            np.random.default_rng(setup.seed),
            start_us=start_us,
            aircraft=asked.model_copy(update={"wind": wind}),
            airframe=draw_airframe(nominal, asked.spread, stream(setup.seed, Stream.AIRFRAME)),
            rate_hz=self.autopilot.rate_hz,
            computer_w=setup.computer_w,
        )
        self.autopilot.use_truth(self.plant.truth)
        self.faults: FaultTimeline | None = None
        """What fails in this episode; None: nothing does."""
        self._fly: Callable[[SensorSample], ActuatorControls] = self.autopilot.step
        self._setup = setup
        if asked.faults:
            self._let_fail(start_us)
        if self.autopilot.internals is not None:
            self.autopilot.internals.failures = ClientFaults(self._faults_now)
        self._camera: OnboardCamera | None = None
        """None on an endless floor."""
        if setup.arena is not None:
            vehicle = setup.vehicle
            self._camera = camera_by(
                *(vehicle.camera, setup.arena, start_us, asked.sensors, setup.seed),
                *(asked.renderer, vehicle.cameras),
            )
            if self.faults is not None:
                self._camera = FailingCamera(self._camera, self.faults, setup.seed)
        self.recorder: FlightRecorder | None = None
        """None = nothing is recorded."""
        if recording:
            self.recorder = FlightRecorder(self.autopilot.internals, read_by)
        self.start_us = start_us
        self.time_us = start_us
        """Simulated time of the newest sample."""
        self._clock = clock
        self._sample: SensorSample = self.plant.sense()

    def begin(self) -> None:
        """Say that the episode begins now: what was flown and recorded so far is no part of it."""
        self.start_us = self.time_us
        if self.recorder is not None:
            self.recorder.begin()
        self.plant.begin()
        if self.faults is not None:
            self.faults.begin(self.start_us)
        if self._camera is not None:
            self._camera.restart(self.start_us)

    def _let_fail(self, start_us: int) -> FaultTimeline:
        """Put between plant and flight controller what may fail, and return its faults."""
        setup = self._setup
        self.faults = FaultTimeline(setup.aircraft.faults, setup.seed, start_us)
        self._fly = FailingParts(self.autopilot, self.plant, setup.vehicle, self.faults).step
        return self.faults

    def _faults_now(self) -> FaultTimeline:
        faults = self.faults or self._let_fail(self.start_us)
        faults.update(self.time_us, self.autopilot.flight)
        return faults

    @property
    def truth(self) -> Truth:
        """The true state now; made anew at every call."""
        return self.plant.truth()

    def tick(self) -> None:
        """Run autopilot, then plant, for one tick."""
        plant, recorder = self.plant, self.recorder
        if recorder is None:
            plant.collisions.clear()
            self._sample = plant.step(self._fly(self._sample))
        else:
            recorder.before_controls()
            controls = self._fly(self._sample)
            recorder.after_controls(self._clock.time_us())
            self._sample = plant.step(controls)
            recorder.moved(plant)
        self.time_us = plant.time_us

    def capture_due(self, publish: Callable[[Frame], None]) -> None:
        """Hand a depth frame to `publish` when the camera is due; an endless floor has none."""
        camera = self._camera
        if camera is not None and self.time_us >= camera.next_us:
            row = self.plant.motion
            motion = Motion(row[POSITION], row[QUATERNION], row[VELOCITY], row[RATES])
            camera.offer(self.time_us, motion, publish)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what was recorded so far, by the names of its file (docs/run-folder.md)."""
        if self.recorder is None:
            return {}
        acted = [] if self.faults is None else self.faults.acted(self.time_us)
        return self.recorder.arrays() | fault_arrays(acted)

    def snapshot(self) -> SimulationSnapshot:
        """Return the present state; `restore` makes simulations of it that fly on bit-identically.

        Raises ValueError for real firmware, and for a simulation whose flight is logged or linked.
        """
        setup = self._setup
        return SimulationSnapshot(self, setup, setup.vehicle, setup.arena, self._clock)

    def close(self) -> None:
        """Release the physics server and the autopilot."""
        self.plant.close()
        self.autopilot.close()
