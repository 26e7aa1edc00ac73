"""Estimator: an error-state extended Kalman filter.

`error_state` defines the states and sensor models. A filter carries the error's covariance:
`KernelFilter` is the default, `filter_filterpy` its reference. This module is the sequence: wait
at rest, align, then predict and fuse the available measurements.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from airl_mav.core import addons, constants, frames
from airl_mav.vehicle.atmosphere import altitude_m
from firmware_sim.autopilot import alignment, autopilot_state, error_state, yaw_estimator
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.recovery import Recovery, RecoveryState
from firmware_sim.engine.record import (
    GPS,
    MAG,
    OFF,
    PRESSURE,
    SUSPECT,
    TRUSTED,
    Record,
    new_controller,
)
from firmware_sim.engine.ticks import HEADING_BY_TURN_NED, settle_record
from firmware_sim.interfaces import GpsFix, Received, SensorSample

_NO_COMPASS = 5
"""EKF2_MAG_TYPE: the compass is not used."""

GPS_GONE_US = 1_000_000
"""Time without GPS fusion after which GPS counts as lost (EKF2: its data are delayed) [µs]."""

BIAS_STEP_S = 0.01
"""Time step of PX4's filter, 100 Hz [s]; its bias process noises (EKF2_*_B_NOISE) are per step."""

BARO_WALK_M_SQRT_S = 0.01
"""Process noise of the barometer offset [m/sqrt(s)]."""

_POSITION, _VELOCITY = slice(es.P, es.V), slice(es.V, es.Q)
_ACCELERATION = slice(es.ACCELERATION, es.SIGMA)
_QUATERNION, _ANGULAR_VELOCITY = slice(es.Q, es.RATES), slice(es.RATES, es.GYRO_BIAS)
_GYRO_BIAS = slice(es.GYRO_BIAS, es.ACCEL_BIAS)
_ACCEL_BIAS = slice(es.ACCEL_BIAS, es.BARO_OFFSET)
_SIGMA, _INNOVATION_RATIO = slice(es.SIGMA, es.RATIO), slice(es.RATIO, None)
"""Slices of the state for the fields of an `StateEstimate`."""


class Aiding:
    """Fusion of sensors beside GPS, barometer and compass: none here.

    An add-on names its implementation in the table AIDING. It fuses through the public attributes
    of the `Estimator`, and keeps the attributes below up to date.
    """

    is_idle = True
    """True if nothing is fused and nothing needs every tick: compiled ticks may run."""
    sees_vision = False
    """True if poses of external vision are fused."""
    gives_heading = False
    """True if the compass must not be fused."""
    gives_height = False
    """True if GPS height must not be fused: two height sources would differ by a bias."""
    is_reference = False
    """True if the ground is the height reference: of GPS only the vertical speed is fused."""
    ground: autopilot_state.Clearance | None = None
    """Height above ground; None = not measured."""

    def __init__(self, estimator: Estimator) -> None:
        """Start without measurements."""

    @staticmethod
    def warm_up(value: Callable[[str], float]) -> None:
        """Compile all kernels, with a look-up for parameters."""

    def step(self, sample: SensorSample) -> None:
        """Fuse a tick's sample, after GPS, barometer and compass."""

    def receive(self, name: str, reading: Any) -> bool:
        """Process a reading of a client's sensor; return False if none of its kind is fused."""
        del name, reading
        return False

    def height_moved(self, down_m: float) -> None:
        """Shift all heights with the origin of local NED, positive down [m]."""

    def correct(self, baro: error_state.Measurement) -> None:
        """Correct the offset of a barometer that was rejected, if another height is trusted."""

    def knows_motion(self, now_us: int, longest_us: float, *, flying: bool) -> bool:
        """Return whether horizontal motion was measured within a time [µs]."""
        del now_us, longest_us, flying
        return False

    def knows_height(self, now_us: int, longest_us: float) -> bool:
        """Return whether height was measured within a time [µs]."""
        del now_us, longest_us
        return False


def _in_record(name: str, kind: type) -> Any:
    """Return a property that is a field of the flight controller's record."""
    return property(
        lambda self: kind(self.record[name].item(0)),
        lambda self, value: self.record.__setitem__(name, value),
    )


def aiding() -> type[Aiding]:
    """Return the installed fusion of further sensors."""
    for place in addons.entries("firmware_sim", "AIDING").values():
        found: type[Aiding] = addons.load(place)
        return found
    return Aiding


class Estimator:
    """Estimator of position, velocity, attitude and biases from noisy sensors."""

    def __init__(
        self,
        value: Callable[[str], float],
        new_filter: error_state.NewFilter = error_state.KernelFilter,
        record: Record | None = None,
    ) -> None:
        """Start unaligned, with a look-up for EKF2_* parameters and a factory of the filter.

        `record` is the flight controller's, with state and covariance; None = a new record.
        """
        self.record = record = new_controller() if record is None else record
        """Record of the flight controller."""
        self.value = value
        """Look-up for EKF2_* parameters by name."""
        self.origin: frames.Geodetic | None = None
        """Geodetic origin of local NED: mean of the first fixes, or a client's choice; None while
        unknown."""
        self.state: frames.Vector = record["state"][0]
        """Nominal state in the layout of `error_state`."""
        self.state[:] = es.new_state()
        self.filter = new_filter(np.diag(es.INITIAL_SIGMA**2), self._process_noise())
        """Filter for the error's covariance."""
        if isinstance(self.filter, error_state.KernelFilter):
            # Compiled ticks read the arrays of the record, so the filter works in place there.
            self.filter.keep_in(
                record["covariance"][0], record["transition"][0], record["process_noise"][0]
            )
        self.innovations: Callable[[str, frames.Vector, frames.Vector], None] | None = None
        """Callback with name, innovation and its covariance for every measurement."""
        self._alignment = alignment.Alignment(value, record)
        self._chosen_origin: frames.Geodetic | None = None
        """Origin of local NED chosen before alignment; None = the vehicle's position."""
        self.time_us = 0
        """Time of the newest sample [µs]."""
        self._fixed_us: int | None = None
        """Time of alignment with a GPS position; None: not aligned, or aligned without GPS."""
        self._estimate: autopilot_state.StateEstimate | None = None
        # GPS is fused in two parts, so a bad height does not reject a good horizontal fix.
        horizontal = error_state.selecting(es.POS, es.POS + 1, es.VEL, es.VEL + 1)
        record["gps_horizontal_h"] = horizontal
        record["gps_vertical_h"] = error_state.selecting(es.POS + 2, es.VEL + 2)
        self._gps_horizontal = error_state.Measurement(
            "gps_horizontal", 0, record["gps_horizontal_h"][0], record["gps_horizontal_us"]
        )
        self.gps_vertical = error_state.Measurement(
            "gps_vertical", 3, record["gps_vertical_h"][0], record["gps_vertical_us"]
        )
        self._gps_sinking = error_state.Measurement(
            "gps_down_velocity", 3, error_state.selecting(es.VEL + 2)
        )
        # A barometer measures -z plus its own offset.
        record["baro_h"] = error_state.selecting(es.BARO) - error_state.selecting(es.POS + 2)
        self.baro = error_state.Measurement("baro", 1, record["baro_h"][0], record["baro_fused_us"])
        # `observe_heading` writes this Jacobian for every sample: it depends on the attitude.
        heading_h, heading_us = record["heading_h"][0], record["heading_fused_us"]
        self._heading = error_state.Measurement("heading", 2, heading_h, heading_us)
        self._horizon = error_state.FusionHorizon()
        self.yaw = yaw_estimator.YawEstimator(record)
        """Heading estimate without a compass."""
        self.recovery = Recovery(self.state, self.filter, self.yaw, record)
        """Recovery from inertial sensor and heading faults."""
        self.horizons = [self._horizon]
        """Horizons of delayed measurements."""
        self.is_north_known = True
        """True if the heading is relative to north; False: relative to a local frame."""
        self.readings: dict[str, Received] = {}
        """Newest readings of further sensors by name (`sensor_table.Sensor.reading`)."""
        self.aiding = aiding()(self)
        """Fusion of further sensors."""
        self.is_changed = True
        """True if Python has changed inputs of compiled ticks; see `prepare`."""

    healthy: bool = _in_record("healthy", bool)
    """True if converged: the vehicle may arm and fly."""
    flying: bool = _in_record("flying", bool)
    """True if the vehicle is in the air; set by the caller."""
    aligned: bool = _in_record("aligned", bool)
    """True if the attitude is known: the sensors have been averaged at rest."""
    _origin_altitude_baro: float = _in_record("baro_origin_m", float)
    """Barometer altitude of local NED's origin [m]."""

    def step(self, sample: SensorSample) -> None:
        """Process one tick's sensors."""
        self.time_us, self._estimate, self.is_changed = sample.time_us, None, True
        # Alignment and logs read the newest samples from the record.
        self._note(sample)
        if not self.aligned:
            measured = MAG * (sample.mag is not None) | PRESSURE * (sample.pressure_hpa is not None)
            alignment.add_record(self.record, measured | GPS * (sample.gps is not None))
            self.align()
        else:
            self._predict(sample)
            # The yaw estimator runs beside the filter and needs every IMU sample.
            self.yaw.feel(sample.gyro, sample.accel)
            self._fuse_slower(sample)
            self.aiding.step(sample)
        if sample.further is not None:
            for name, reading in sample.further.items():
                self.readings[name] = Received(reading, sample.time_us)
        self._settle()

    def _note(self, sample: SensorSample) -> None:
        record = self.record
        record["time_us"], record["accel"], record["gyro"] = (
            sample.time_us,
            sample.accel,
            sample.gyro,
        )
        record["temperature_c"] = sample.temperature_c
        record["battery_left"] = sample.battery.remaining
        if sample.mag is not None:
            record["mag"] = sample.mag
        if sample.pressure_hpa is not None:
            record["pressure_hpa"] = sample.pressure_hpa
        if sample.gps is not None:
            record["gps_position"] = frames.geodetic_to_local(sample.gps.position, frames.HOME)
            record["gps_velocity"] = sample.gps.velocity_ned

    def _fuse_slower(self, sample: SensorSample) -> None:
        """Fuse the measurements of GPS, barometer and compass."""
        if sample.gps is not None and self.uses_gps:
            self._fuse_gps(sample.gps)
        if sample.pressure_hpa is not None:
            self._fuse_baro(sample.pressure_hpa)
        if sample.mag is not None:
            self._fuse_heading(sample.mag)

    def _settle(self) -> None:
        converged = es.converged(self.state, self.filter.covariance)
        self.healthy = converged and self.aligned

    # --- compiled ticks

    @property
    def compiled(self) -> bool:
        """True if compiled ticks are equivalent to `step`: GPS is the only aid in use."""
        # These conditions need code that exists only in Python.
        return (
            self.aiding.is_idle
            and self.innovations is None
            and not self._horizon.is_past
            and isinstance(self.filter, error_state.KernelFilter)
        )

    def prepare(self) -> None:
        """Write the filter's parameters and sensor modes to the record.

        Does nothing unless Python has changed something since the last call.
        """
        if not self.is_changed:
            return
        self.is_changed = False
        record, value = self.record, self.value
        record["baro_variance"] = value("EKF2_BARO_NOISE") ** 2
        record["heading_variance"] = value("EKF2_HEAD_NOISE") ** 2
        record["gps_variance"] = value("EKF2_GPS_P_NOISE") ** 2, value("EKF2_GPS_V_NOISE") ** 2
        # NaN marks an unknown origin; the compiled tick then leaves fixes to Python.
        record["origin"] = self.origin or (math.nan,) * 3
        # A delayed horizon excludes compiled ticks, see `compiled`.
        self._horizon.assume(value("EKF2_GPS_DELAY"))
        self._suspect()

    def _suspect(self) -> None:
        """Write to the record which sensors require a check of every sample."""
        recovery = self.recovery
        headed, moving = recovery.consistency.heading_deviates, recovery.consistency
        suspect = recovery.compass.is_suspect or headed
        used = self.value("EKF2_MAG_TYPE") != _NO_COMPASS
        self.record["compass"] = OFF if not used else SUSPECT if suspect else TRUSTED
        suspect = moving.velocity_deviates or recovery.emergency.is_doubted(self.time_us)
        self.record["gps"] = OFF if not self.uses_gps else SUSPECT if suspect else TRUSTED

    def fuse_rest(self, sample: SensorSample) -> None:
        """Fuse the measurements that a compiled tick leaves to Python."""
        self.time_us, self._estimate = sample.time_us, None
        self._fuse_slower(sample)
        self._suspect()
        # The same test of convergence as in compiled ticks.
        settle_record(self.record)

    def flown(self) -> int:
        """Process the end of compiled ticks; return the time of the estimate [µs]."""
        self.time_us, self._estimate = self.record["time_us"].item(0), None
        return self.time_us

    def receive(self, name: str, reading: Any) -> bool:
        """Process a reading of a client's sensor, received now; False = its kind is not fused."""
        fused = self.aiding.receive(name, reading)
        self._estimate = None
        return fused

    def estimate(self) -> autopilot_state.StateEstimate:
        """Return a copy of the estimate after the newest tick."""
        if self._estimate is None:
            row = self.state.copy()
            # Positional arguments and prebuilt slices: this runs in nearly every tick.
            self._estimate = autopilot_state.StateEstimate(
                self.time_us,
                row[_POSITION],
                row[_VELOCITY],
                row[_ACCELERATION],
                row[_QUATERNION],
                row[_ANGULAR_VELOCITY],
                row[_GYRO_BIAS],
                row[_ACCEL_BIAS],
                row[_SIGMA],
                row[_INNOVATION_RATIO],
                self.healthy,
            )
        return self._estimate

    def move_origin(self, origin: frames.Geodetic) -> None:
        """Move the origin of local NED; the vehicle's geodetic position is unchanged.

        Source: PX4 1.16, Ekf::setEkfGlobalOrigin.
        """
        before, self._chosen_origin, self.is_changed = self.origin, origin, True
        if before is None:
            if self.aligned:
                # Local NED continues; its geodetic origin is now known.
                self.origin, self._estimate = origin, None
            return
        # The vehicle stays at its geodetic position, so its local position changes.
        here = frames.local_to_geodetic(self.state[es.P : es.V], before)
        self.state[es.P : es.V] = frames.geodetic_to_local(here, origin)
        # Terrain and barometer refer to the origin's altitude and shift with it.
        self.aiding.height_moved(origin.altitude_m - before.altitude_m)
        self._origin_altitude_baro += origin.altitude_m - before.altitude_m
        self.origin, self._estimate = origin, None

    # --- validity (PX4: EKF2's dead reckoning)

    def knows_position(self, now_us: int, *, flying: bool = True) -> bool:
        """Return whether horizontal position and velocity are valid.

        Without GPS they stay valid for EKF2_NOAID_TOUT in flight (dead reckoning). On the ground,
        where the biases are barely observable, the limit is `GPS_GONE_US`.
        """
        longest_us = self.value("EKF2_NOAID_TOUT") if flying else GPS_GONE_US
        if not self.aligned:
            return False
        return self._recent(self._gps_horizontal, now_us, longest_us) or self.aiding.knows_motion(
            now_us, longest_us, flying=flying
        )

    def knows_height(self, now_us: int) -> bool:
        """Return whether height and vertical speed are valid: barometer or GPS, as above."""
        longest_us = self.value("EKF2_NOAID_TOUT")
        return self.aligned and (
            self._recent(self.baro, now_us, longest_us)
            or self._recent(self.gps_vertical, now_us, longest_us)
            or self.aiding.knows_height(now_us, longest_us)
        )

    @property
    def knows_place(self) -> bool:
        """True if positions in local NED can be converted to geodetic ones."""
        return self.origin is not None and self.is_north_known

    def fuses_gps(self, now_us: int) -> bool:
        """Return whether GPS was fused recently."""
        fused = self._gps_horizontal.fused_us
        return fused is not None and now_us - fused <= GPS_GONE_US

    @property
    def field_disturbed(self) -> bool:
        """True if the compass measures a field other than the earth's, by EKF2_MAG_CHECK."""
        # Before alignment, use the mean field at rest.
        field = self.record["mag"][0] if self.aligned else self._alignment.field
        if field is None:
            return False
        return alignment.FieldCheck.read(self.value).disturbed(field, es.attitude(self.state))

    def accuracy(self) -> tuple[float, float]:
        """Return the standard deviations of horizontal position [m] and velocity [m/s]."""
        north, east = self.state[es.SIGMA : es.SIGMA + 2].tolist()
        v_north, v_east = self.state[es.SIGMA + 3 : es.SIGMA + 5].tolist()
        return math.hypot(north, east), math.hypot(v_north, v_east)

    def _recent(self, m: error_state.Measurement, now_us: int, longest_us: float) -> bool:
        """Return whether a measurement was fused recently; a GPS alignment counts for all."""
        fused_us = m.fused_us
        since = self._fixed_us if fused_us is None else fused_us
        return since is not None and now_us - since <= longest_us

    # --- start

    def align(self) -> bool:
        """Align attitude, height and position from the averages at rest; return success."""
        aligned = self._alignment.finish()
        if aligned is None:
            return False
        self.aligned = self.is_changed = True
        self.state[es.Q : es.RATES] = aligned.quaternion
        # Without a compass the heading is arbitrary: local NED is not yet geographic.
        self.is_north_known = aligned.by_compass
        self._origin_altitude_baro = aligned.altitude_baro_m
        if aligned.fix is not None:
            self.origin, self._fixed_us = aligned.fix, self.time_us
        # The origin is at the vehicle here: move it to the chosen place.
        if self._chosen_origin is not None:
            self.move_origin(self._chosen_origin)
        return True

    @property
    def uses_gps(self) -> bool:
        """True if GPS fusion is enabled by EKF2_GPS_CTRL."""
        return self.value("EKF2_GPS_CTRL") != 0

    def _process_noise(self) -> frames.Vector:
        value = self.value
        q = np.zeros(es.N_STATES)
        # As in PX4, the variance grows by (noise dt)² per step.
        q[es.VEL : es.ATT] = (value("EKF2_ACC_NOISE") * constants.TICK_S) ** 2
        q[es.ATT : es.GYRO] = (value("EKF2_GYR_NOISE") * constants.TICK_S) ** 2
        # Bias noises are per PX4 step: scale the variance from 100 Hz to this tick rate.
        q[es.GYRO : es.ACC] = value("EKF2_GYR_B_NOISE") ** 2 * BIAS_STEP_S * constants.TICK_S
        q[es.ACC : es.BARO] = value("EKF2_ACC_B_NOISE") ** 2 * BIAS_STEP_S * constants.TICK_S
        q[es.BARO] = BARO_WALK_M_SQRT_S**2 * constants.TICK_S
        return q

    def _predict(self, sample: SensorSample) -> None:
        state = self.state
        # Only delayed horizons need the motion of every tick.
        past = [each for each in self.horizons if each.is_past]
        before = state[es.P : es.Q].copy() if past else None
        self.filter.predict(state, sample.gyro, sample.accel)
        if before is not None:
            for each in past:
                each.moved(before, state[es.P : es.Q])

    # --- measurements

    def fuse(self, m: error_state.Measurement) -> bool:
        """Fuse a measurement if it is within the gate; return whether it was."""
        if self.innovations is not None:
            # Consistency tests need the innovation before the fusion changes the state.
            s = m.h @ self.filter.covariance @ m.h.T + np.diag(m.variance)
            self.innovations(m.name, m.innovation.copy(), s)
        ratio = self.filter.fuse(self.state, m.innovation, m.h, m.variance)
        self.state[m.slot] = ratio
        # False for NaN, too: a NaN never counts as fused.
        within = ratio <= 1.0
        if within:
            m.fused_us = self.time_us
        return within

    def _fuse_gps(self, fix: GpsFix) -> None:
        if self.origin is None:
            # Vision has defined the local position; the first fix gives its geodetic origin.
            self.origin = frames.local_to_geodetic(-self.state[es.P : es.V], fix.position)
        measured, value = frames.geodetic_to_local(fix.position, self.origin), self.value
        r_p, r_v = value("EKF2_GPS_P_NOISE") ** 2, value("EKF2_GPS_V_NOISE") ** 2
        self._horizon.assume(value("EKF2_GPS_DELAY"))
        self._observe_yaw(fix.velocity_ned, math.sqrt(r_v))
        recovery, now = self.recovery, self.now
        # The excess of earlier fixes: a fix must not change its own weight.
        excess = recovery.consistency.velocity_excess
        recovery.take_velocity(fix.velocity_ned - self._then()[3:], r_v, now)
        r_v *= excess
        # A heading reset moves the state, so it comes before the innovations.
        if recovery.heading_is_wrong(now):
            recovery.turn(measured, fix.velocity_ned, self._then().copy(), r_p, r_v, now)
        m, then = self._gps_horizontal, self._then()
        m.innovation[:2] = measured[:2] - then[:2]
        m.innovation[2:] = fix.velocity_ned[:2] - then[3:5]
        m.variance[:2], m.variance[2:] = r_p, r_v
        self.fuse(m)
        # The horizontal fusion has changed the state: read the reference again.
        m, then = self.gps_vertical, self._then()
        m.innovation[0] = measured[2] - then[2]
        m.innovation[1] = fix.velocity_ned[2] - then[5]
        # The height error of a receiver is about twice its horizontal error.
        m.variance[0], m.variance[1] = max(fix.epv_m, math.sqrt(r_p)) ** 2, r_v
        if self.aiding.is_reference:
            # The ground is the height reference: GPS height would need a separate bias state.
            sinking = self._gps_sinking
            sinking.innovation[0], sinking.variance[0] = m.innovation[1], r_v
            self.fuse(sinking)
        # The bias between two height sources is not estimated: fuse only one of them.
        elif not self.aiding.gives_height:
            self.fuse(m)

    def _observe_yaw(self, velocity: frames.Vector, accuracy: float) -> None:
        state = self.state
        if self._horizon.is_past:
            # The yaw estimator runs in the present: shift a delayed velocity to now.
            velocity = velocity + state[es.V : es.Q] - self._then()[3:]
        bias = state[es.GYRO_BIAS : es.ACCEL_BIAS]
        self.yaw.observe(velocity, accuracy, bias, flying=self.flying)

    def _then(self) -> frames.Vector:
        """Return position and velocity (6,) NED at the measurement time of the current fix."""
        state, horizon = self.state, self._horizon
        return horizon.seen_from(state) if horizon.is_past else state[es.P : es.Q]

    def _fuse_baro(self, pressure: float) -> None:
        height = altitude_m(pressure) - self._origin_altitude_baro
        # The filter's height is -z; the barometer reads it with its offset.
        expected = -self.state.item(es.P + 2) + self.state.item(es.BARO_OFFSET)
        self.baro.innovation[0] = height - expected
        self.baro.variance[0] = self.value("EKF2_BARO_NOISE") ** 2
        if not self.fuse(self.baro):
            self.aiding.correct(self.baro)

    def _fuse_heading(self, field: frames.Vector) -> None:
        if self.aiding.gives_heading or self.value("EKF2_MAG_TYPE") == _NO_COMPASS:
            return
        m = self._heading
        observable = es.observe_heading(
            self.state, field, frames.MAGNETIC_DECLINATION, HEADING_BY_TURN_NED, m.innovation, m.h
        )
        innovation = m.innovation.item(0)
        if not (observable and self.recovery.compass.admits(innovation)):
            return
        m.variance[0] = self.value("EKF2_HEAD_NOISE") ** 2
        self.fuse(m)
        self.recovery.take_heading(innovation, self.state.item(m.slot), self.now)

    # --- inertial sensor faults

    @property
    def now(self) -> RecoveryState:
        """Time and flight state for `recovery`."""
        return RecoveryState(self.time_us, self.flying, self._gps_horizontal.fused_us)
