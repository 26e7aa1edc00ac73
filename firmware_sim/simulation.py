"""Simulation of one vehicle in one arena, and detection of its crashes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera import frame, render
from airl_mav.core import constants
from airl_mav.core.clock import Clock
from airl_mav.core.frames import Geodetic
from airl_mav.core.streams import Stream, stream
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft
from airl_mav.vehicle.airframe import Airframe, draw_airframe
from airl_mav.vehicle.atmosphere import wind_of_episode
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.commander import CommanderState, FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.parameter_store import Keeper, Parameters
from firmware_sim.engine.dynamics import POSITION, QUATERNION, RATES, VELOCITY
from firmware_sim.engine.record import FLOWN_TICK, TRUE_TICK
from firmware_sim.engine.ticks import (
    ALIGN,
    COLLIDED,
    EMPTY,
    FUSE,
    HEALTH,
    log_flown_record,
    log_record,
)
from firmware_sim.fault_timeline import ClientFaults, FaultTimeline, fault_effect
from firmware_sim.interfaces import ActuatorControls, FlightController, SensorSample, TrueState
from firmware_sim.pacing import Arrivals
from firmware_sim.plant.body import FLOOR
from firmware_sim.plant.camera import OnboardCamera, SimulatedCamera
from firmware_sim.plant.plant import Collision, Plant
from firmware_sim.recording import FlightRecorder, fault_arrays

GROUND_LIMIT_S = 30.0
"""Maximum time for boot, arming, spin-up and the approach of the altitude [s]."""

CLIMB_LIMIT_M_S = 0.5
"""Minimum mean climb speed [m/s]; PX4 takes off at 1.5 m/s."""

LOOK_US = constants.US_PER_S // 10
"""Interval of checks of the vehicle's state [µs]."""

ARM_RETRY_US = constants.US_PER_S
"""Interval of arm requests while pre-arm checks fail [µs]."""

NEVER_US = 1 << 61
"""Start of the episode for its faults during the take-off [µs]: never."""


class HoverStart(NamedTuple):
    """Height and origin of a hover start."""

    altitude_m: float
    """Height above the start [m]."""
    origin: Geodetic | None = None
    """Geodetic start position for a vehicle without GPS; None = measured by GPS."""

    def fly(self, simulation: Simulation) -> bool:
        """Take off and hold at the altitude; call `Simulation.begin` afterwards.

        Moving obstacles are stationary and faults inactive until then. Requires the built-in
        autopilot, at rest on the ground.

        Returns:
            True if the altitude was reached. Otherwise the vehicle stays where the attempt ended,
            and clients receive the texts that explain the reason.
        """
        autopilot = simulation.autopilot.internals
        assert autopilot is not None  # noqa: S101 (`airl_mav.scenario.checks` refuses others)
        if self.origin is not None:
            autopilot.set_origin(self.origin)
        recorder, simulation.recorder = simulation.recorder, None
        on_message, autopilot.on_message = autopilot.on_message, None
        if simulation.faults is not None:
            simulation.faults.begin(NEVER_US)
        limit_s = GROUND_LIMIT_S + self.altitude_m / CLIMB_LIMIT_M_S
        reached = self._climb(
            simulation, autopilot, simulation.time_us + round(limit_s * constants.US_PER_S)
        )
        simulation.recorder, autopilot.on_message = recorder, on_message
        if reached:
            autopilot.take_messages()
            autopilot.take_events()
        return reached

    def _climb(self, simulation: Simulation, autopilot: BuiltinAutopilot, until_us: int) -> bool:
        """Arm and climb; return True if the altitude is reached before `until_us` [µs]."""
        start_m, arm_us = 0.0, simulation.time_us
        simulation.plant.hold_obstacles()
        while simulation.time_us < until_us:
            look_us = simulation.time_us + LOOK_US
            while simulation.time_us < look_us:
                simulation.advance(look_us)
            flight, estimate = autopilot.flight, autopilot.estimator.estimate()
            down_m, down_m_s = estimate.position.item(2), estimate.velocity.item(2)
            if flight.phase is FlightPhase.STANDBY and simulation.time_us >= arm_us:
                start_m, arm_us = down_m, simulation.time_us + ARM_RETRY_US
                if autopilot.arm(force=False) is Result.ACCEPTED:
                    autopilot.takeoff(self.altitude_m)
            elif flight.phase is FlightPhase.AIR and flight.mode is Mode.HOLD:
                height_m = start_m - down_m
                climbs = height_m < self.altitude_m - constants.TAKEOFF_REACHED_M
                if not climbs and abs(down_m_s) < constants.TAKEOFF_REACHED_M_S:
                    return True
        return False


MOST_TICKS = constants.US_PER_S // constants.TICK_US
"""Maximum number of ticks in one call of `advance`."""

LOG_TICKS = 2 * MOST_TICKS
"""Capacity of the logs [ticks]; full logs are moved to the recorder."""

_ENDS = (COLLIDED, ALIGN, HEALTH, EMPTY)
"""Events that always end a call of `advance`."""


@dataclass(frozen=True)
class EpisodeSetup:
    """Vehicle, arena and conditions of an episode."""

    vehicle: VehicleProfile
    arena: Arena | None
    """Arena; None = an endless floor."""
    seed: int
    """Seed of sensors, wind and domain randomization."""
    aircraft: Aircraft = field(default_factory=Aircraft)
    """Wind, domain randomization, sensors, estimator and battery charge."""
    computer_w: float = 0.0
    """Power of the onboard computer [W]."""
    hover: HoverStart | None = None
    """Hover start of the episode; None = start on the ground."""


def builtin_autopilot(setup: EpisodeSetup, keeper: Keeper | None = None) -> BuiltinAutopilot:
    """Boot the built-in autopilot.

    `keeper` stores parameters set by users. Raises UsageError for an invalid parameter of the
    vehicle, or when stored parameters cannot be read.
    """
    overrides = dict(setup.vehicle.autopilot_parameters())
    if instance := setup.aircraft.real.instance:
        overrides["MAV_SYS_ID"] = instance + 1  # as PX4 SITL's rcS sets it
    parameters = Parameters(overrides, keeper, setup.vehicle.px4_release)
    if setup.aircraft.estimator == "kernel":
        return BuiltinAutopilot(parameters)
    # FilterPy's filter, equal up to rounding. Imported late, as it imports scipy.stats.
    from firmware_sim.autopilot.filter_filterpy import FilterpyFilter

    return BuiltinAutopilot(parameters, FilterpyFilter)


class Simulation:
    """Plant and autopilot of one episode, independent of MAVLink, sockets and pacing."""

    def __init__(
        self,
        setup: EpisodeSetup,
        *,
        start_us: int,
        clock: Clock,
        autopilot: FlightController | None = None,
        recording: bool = True,
        read_by: Callable[[int], int] | None = None,
    ) -> None:
        """Put the vehicle at the start.

        Args:
            setup: Vehicle, arena, seed and aircraft options.
            start_us: Simulated time of the first sample [µs], a multiple of the tick.
            clock: Clock for time stamps only; `tick` and `advance` advance the time.
            autopilot: Booted flight controller; None = boot the built-in autopilot.
            recording: True to record the flight; unrecorded flights may last indefinitely.
            read_by: For the record, maps the start of a read [µs] to a time by which the data had
                arrived [µs]; None = reads take no time.

        Raises:
            UsageError: The vehicle's parameter overrides are invalid.
        """
        aircraft, nominal = setup.aircraft, Airframe.from_profile(setup.vehicle)
        wind = wind_of_episode(aircraft.wind, setup.seed)
        self.autopilot: FlightController = autopilot or builtin_autopilot(setup)
        self._internals = self.autopilot.internals
        self.plant = Plant(
            setup.vehicle,
            setup.arena,
            np.random.default_rng(setup.seed),
            start_us=start_us,
            aircraft=aircraft.model_copy(update={"wind": wind}),
            airframe=draw_airframe(nominal, aircraft.spread, stream(setup.seed, Stream.AIRFRAME)),
            rate_hz=self.autopilot.rate_hz,
            computer_w=setup.computer_w,
            body_by=self.autopilot.body_by,
        )
        self.autopilot.use_truth(self.plant.truth)
        self.faults: FaultTimeline | None = None
        """Faults of this episode; None = no faults."""
        self._fly: Callable[[SensorSample], ActuatorControls] = self.autopilot.step
        self._unaltered = self._fly
        """The flight controller's step, without faults."""
        self._setup = setup
        if aircraft.faults:
            self._let_fail(start_us)
        if self.autopilot.internals is not None:
            self.autopilot.internals.failures = ClientFaults(self._faults_now)
        self._camera: OnboardCamera | None = None
        """Camera; None on an endless floor."""
        if setup.arena is not None:
            vehicle = setup.vehicle
            self._camera = SimulatedCamera(
                *(vehicle.camera, setup.arena, start_us, aircraft.sensors, setup.seed),
                vehicle.cameras,
            )
            if self.faults is not None:
                failing_camera = fault_effect("camera")
                self._camera = failing_camera(self._camera, self.faults, setup.seed)
        self.recorder: FlightRecorder | None = None
        """Flight recorder; None = no recording."""
        if recording:
            self.recorder = FlightRecorder(self.autopilot.internals, read_by)
        self.start_us = start_us
        self.time_us = start_us
        """Simulated time of the newest sample [µs]."""
        self.is_flying = False
        """True during `advance`."""
        self._truths = np.zeros(LOG_TICKS, TRUE_TICK)
        self._flown = np.zeros(LOG_TICKS, FLOWN_TICK)
        self._logged = self._recorded = 0
        """Number of ticks in the logs, and of those already recorded."""
        self.truths = self._truths[:0]
        """Log of the aircraft in the newest ticks (`engine.record.TRUE_TICK`)."""
        self.flown = self._flown[:0]
        """Log of the built-in flight controller in these ticks (`engine.record.FLOWN_TICK`)."""
        self._clock = clock
        self._sample: SensorSample | None = self.plant.sense()
        """Newest sample; None = the newest tick was compiled, its sample is in the plant."""

    def begin(self) -> None:
        """Start the episode: discard everything flown and recorded so far."""
        self.start_us = self.time_us
        self._recorded = self._logged
        if self.recorder is not None:
            self.recorder.begin()
        self.plant.begin()
        if self.faults is not None:
            self.faults.begin(self.start_us)
        if self._camera is not None:
            self._camera.restart(self.start_us)

    def _let_fail(self, start_us: int) -> FaultTimeline:
        """Insert the fault layer between plant and flight controller; return its timeline."""
        setup = self._setup
        self.faults = FaultTimeline(setup.aircraft.faults, setup.seed, start_us)
        failing_parts = fault_effect("parts")
        self._fly = failing_parts(self.autopilot, self.plant, setup.vehicle, self.faults).step
        return self.faults

    def _faults_now(self) -> FaultTimeline:
        faults = self.faults or self._let_fail(self.start_us)
        faults.update(self.time_us, self.autopilot.flight)
        return faults

    @property
    def truth(self) -> TrueState:
        """The true state now; a new object at every call."""
        return self.plant.truth()

    def tick(self) -> None:
        """Run autopilot, then plant, for one tick."""
        self.advance(self.time_us)

    def advance(self, until_us: float, arrivals: Arrivals | None = None) -> None:
        """Fly all ticks that begin before simulated `until_us` [µs], at least one.

        Ends earlier after an event or a decision of the autopilot. `arrivals` are delivered
        between ticks; None = no messages.
        """
        plant, recorder, autopilot = self.plant, self.recorder, self._internals
        first_us, self.is_flying = self._clock.time_us(), True
        if self._logged > LOG_TICKS - MOST_TICKS:
            self._record()
            self._logged = self._recorded = 0
        if recorder is None:
            plant.collisions.clear()
        else:
            recorder.before_controls()
        compiled = self._fly is self._unaltered and plant.compiled
        if autopilot is None or not (compiled and autopilot.estimator.compiled):
            done = self._tick_by_python(autopilot)
            self.time_us = plant.time_us
        else:
            done = self._stretch(autopilot, until_us, arrivals)
        self.is_flying = False
        first, self._logged = self._logged, self._logged + done
        self.truths = self._truths[first : self._logged]
        self.flown = self._flown[first : first if autopilot is None else self._logged]
        if recorder is None:
            self._recorded = self._logged
        elif recorder.setpoints.under_way:
            recorder.setpoints.flown(first_us, done)

    def _record(self) -> None:
        """Pass the unrecorded ticks of the logs to the recorder."""
        new = slice(self._recorded, self._logged)
        if self.recorder is not None:
            self.recorder.flown(self._truths[new], self._flown[new])
        self._recorded = self._logged

    def _tick_by_python(self, autopilot: BuiltinAutopilot | None) -> int:
        """Fly one tick in Python, with faults or external firmware for example; return 1."""
        before = self.plant.newest() if self._sample is None else self._sample
        self._sample = sample = self.plant.step(self._fly(before))
        truths, flown = self._truths[self._logged :], self._flown[self._logged :]
        log_record(self.plant.record, truths)
        if autopilot is not None:
            log_flown_record(autopilot.record, flown)
            flown["battery"][0] = sample.battery
            if self._fly is self._unaltered:
                autopilot.take(sample)  # compiled ticks do the same
        return 1

    def _stretch(
        self, autopilot: BuiltinAutopilot, until_us: float, arrivals: Arrivals | None
    ) -> int:
        """Fly compiled ticks; return their number."""
        if self._sample is not None:
            autopilot.take(self._sample)
            self._sample = None
        plant, record, done = self.plant, autopilot.record, 0
        most = max(1, math.ceil(min((until_us - self.time_us) / constants.TICK_US, MOST_TICKS)))
        arrives_us = math.inf if arrivals is None else arrivals.next_us
        while done < most:
            if done and arrivals is not None and arrives_us <= self.time_us:
                arrivals.arrive(self.time_us)
                arrives_us = arrivals.next_us
                if self.recorder is not None:
                    self.recorder.before_controls(done)
            due_us = min(autopilot.decide_if_due(), arrives_us)
            ticks = max(1, math.ceil(min((due_us - self.time_us) / constants.TICK_US, most - done)))
            log = slice(self._logged + done, self._logged + done + ticks)
            flown, event = plant.glide(record, ticks, self._truths[log], self._flown[log])
            if event == FUSE:
                flown += 1
                autopilot.fuse(plant.newest(), record["left"].item(0))
            done += flown
            # Texts about a landing bear the time of the tick that detects it.
            self.time_us += (flown - 1) * constants.TICK_US
            changed = autopilot.flown(plant.newest, event)
            self.time_us += constants.TICK_US
            # Measurements fused in Python can change the aids in use.
            if changed or event in _ENDS or (event == FUSE and not autopilot.estimator.compiled):
                break
        return done

    @property
    def next_frame_us(self) -> float:
        """Simulated time of the camera's next exposure [µs]; inf on an endless floor."""
        return math.inf if self._camera is None else self._camera.next_us

    def capture_due(
        self, until_us: int, publish: Callable[[frame.Frame], None], read_us: int = 0
    ) -> None:
        """Publish the frames that are due by simulated `until_us` [µs], now or in the newest ticks.

        Frames that newer ones replace before `read_us` may be skipped. An endless floor has none.
        """
        camera, truths = self._camera, self.truths
        if camera is not None and read_us > camera.next_us:
            camera.skip_unread(read_us)
        while camera is not None and camera.next_us <= until_us:
            time_us, row = self.time_us, self.plant.motion
            if time_us > until_us:
                k = truths["time_us"].searchsorted(camera.next_us)
                time_us, row = truths["time_us"].item(k), truths["motion"][k].copy()
                if time_us > until_us:
                    break
            motion = render.Motion(row[POSITION], row[QUATERNION], row[VELOCITY], row[RATES])
            camera.offer(time_us, motion, publish)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the recorded arrays by name in the episode file (docs/reference/run-folder.md)."""
        self._record()
        if self.recorder is None:
            return {}
        acted = [] if self.faults is None else self.faults.acted(self.time_us)
        return self.recorder.arrays() | fault_arrays(acted)

    def close(self) -> None:
        """Release the physics server and the autopilot."""
        self.plant.close()
        self.autopilot.close()


TOUCHDOWN_M_S = 2.0
"""Maximum speed of a landing on the floor [m/s]; PX4 lands at 0.7 to 1.5 m/s."""


def is_crash(hit: Collision, flight: CommanderState) -> bool:
    """Return True if a contact ends a flight.

    Contacts with the floor do not end a flight while the vehicle is on the ground, or if they are
    gentle and the mode is neither Offboard nor Hold.
    """
    if hit.what != FLOOR:
        return True
    gentle = flight.mode not in (Mode.OFFBOARD, Mode.HOLD) and hit.speed_m_s < TOUCHDOWN_M_S
    return flight.phase is FlightPhase.AIR and not gentle


class CrashDetector:
    """Detector of the first body hit in flight; call `look` once per tick."""

    def __init__(self) -> None:
        self.hit: str | None = None
        """Name of the first body hit; None = no crash."""
        self._checked = 0

    def look(self, simulation: Simulation) -> bool:
        """Check the contacts of this tick; return True if the first crash is among them."""
        hits = simulation.plant.collisions
        if len(hits) == self._checked:
            return False
        new = hits[self._checked :]
        self._checked = len(hits)
        crashes = [hit.what for hit in new if is_crash(hit, simulation.autopilot.flight)]
        if self.hit is not None or not crashes:
            return False
        self.hit = crashes[0]
        return True
