"""Compiled ticks of one vehicle: control, free flight, sensors, estimator.

A tick starts with the newest sample already fused into the estimate. The control loops compute
motor commands from estimate and demand, the aircraft moves, its sensors measure, and the estimator
fuses the new sample. `stretch` flies many ticks at a constant demand and returns when Python must
act. Its parts `command`, `sense` and `estimate` are for ticks in which Python moves the body
(contacts), changes the sample (faults) or fuses measurements.
"""

from __future__ import annotations

import math

import numpy as np

from airl_mav.control import cascade
from airl_mav.control.demand import AttitudeDemand, Demand, RateDemand, TrajectoryDemand
from airl_mav.control.memory import Biquad
from airl_mav.core import frames
from airl_mav.core.constants import GRAVITY_M_S2, TICK_S, US_PER_S
from airl_mav.core.kernels import kernel, large_kernel
from airl_mav.vehicle import atmosphere
from airl_mav.vehicle.airframe import accelerate, airframe_of, drift
from airl_mav.vehicle.rotation import Vec, conjugate, rotate
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.alignment import ALIGN_US, FIXES, add
from firmware_sim.autopilot.climb import climb_if_due
from firmware_sim.autopilot.error_state import fuse, predict, spread
from firmware_sim.autopilot.land_detector import lifts_off, rests
from firmware_sim.autopilot.recovery import FAR, REFUSED_US, note_velocity
from firmware_sim.autopilot.yaw_estimator import feel, observe
from firmware_sim.engine import dynamics, record

NONE, NOISE, ROOM, FUSE, HEALTH, DETECTED, COLLIDED, ALIGN, EMPTY, CLIMBED = range(10)
"""Events returned by `stretch`: all ticks are flown; a noise block is used up; a contact is
possible in the coming tick; Python must fuse the newest measurements; the estimator's convergence
has changed; the land detector has detected lift-off or landing; the vehicle has hit something
(`Plant.touch`); the estimator can be aligned, or has its first fix; the battery is empty; the
takeoff is near its target altitude."""

REPEATED_BITS = 3
"""Shift of the repeated-sample bits in the result of `estimate`; lower bits as in `measured`."""

EVENT_BITS = 4
"""Shift of the tick count in the result of `stretch`; the lower bits are the event."""

EVENT_MASK = (1 << EVENT_BITS) - 1

FRICTION = 0.8
"""Friction coefficient of the body on the floor, as in `plant.bullet_body`."""

HOLD_SHARE = 0.5
"""Fraction of the friction and tipping limits up to which the floor holds a vehicle at rest."""

LIGHT_SHARE = 0.1
"""Fraction of the weight on the floor below which the vehicle is about to lift off."""

CALM_RATIO = 0.6
"""Maximum test ratio (3 standard deviations) of headings that are fused without further checks; see
`recovery.FAR`."""

PA_PER_HPA = 100.0

_INERTIAL, _COMPASS, _BAROMETER, _GPS, _WIND = range(5)
"""Indices in `noise_at`."""

_NORTH, _EAST, _DOWN = frames.MAGNETIC_FIELD_NED
HEADING_BY_TURN_NED = np.array([-_DOWN * _NORTH, -_DOWN * _EAST, _NORTH**2 + _EAST**2]) / (
    _NORTH**2 + _EAST**2
)
"""Sensitivity of the heading to tilt, in world axes. The field dips, so a tilt error rotates the
measured heading: d innovation / d phi = (-tan(dip) cos(declination), -tan(dip) sin(declination),
1)."""

_HOME_M = frames.HOME.altitude_m
_ATTITUDE, _RATES, _VELOCITY, _THRUST = 0, 4, 7, 10
"""Offsets of the setpoints in `output`."""


# --- control


@kernel
def _store(out: cascade.Output, c: record.Fields) -> None:
    for i in range(4):
        c.output[_ATTITUDE + i] = out.attitude[i]
        c.motors[i] = out.motors[i]
    for i in range(3):
        c.output[_RATES + i] = out.rates[i]
        c.output[_VELOCITY + i] = out.velocity[i]
    c.output[_THRUST] = out.thrust


@large_kernel
def control(c: record.Fields) -> None:
    """Compute motor commands from estimate and demand: one tick of the cascade.

    Updates `output`, `motors` and `memory` of a flight controller.
    """
    kind, s, d = c.demand_kind, c.state, c.demand
    # Stopped motors: the loops do not run, and integrators stay at rest.
    if kind == record.IDLE:
        for i in range(4):
            c.motors[i] = 0.0
        return
    gains, f = c.gains, c.filters
    # Unpack the record once: the control loops take tuples.
    weights = cascade.Filters(f[0], Biquad(f[1], f[2], f[3], f[4], f[5]), f[6], f[7])
    p, v = (s[0], s[1], s[2]), (s[3], s[4], s[5])
    q, w = (s[6], s[7], s[8], s[9]), (s[10], s[11], s[12])
    if kind == record.POSITION:
        demand = Demand((d[0], d[1], d[2]), (d[3], d[4], d[5]), d[6], d[7])
        _store(cascade.cascade_tick(p, v, q, w, demand, c.memory, gains, weights, TICK_S), c)
    elif kind == record.TRAJECTORY:
        path = TrajectoryDemand(
            (d[0], d[1], d[2]), (d[3], d[4], d[5]), (d[6], d[7], d[8]), d[9], d[10]
        )
        _store(cascade.trajectory_tick(p, v, q, w, path, c.memory, gains, weights, TICK_S), c)
    elif kind == record.ATTITUDE:
        attitude = AttitudeDemand((d[0], d[1], d[2], d[3]), d[4], d[5])
        _store(cascade.attitude_tick(v, q, w, attitude, c.memory, gains, weights, TICK_S), c)
    else:
        turn = RateDemand((d[0], d[1], d[2]), d[3])
        _store(cascade.rate_tick(v, q, w, turn, c.memory, gains, weights, TICK_S), c)


@kernel
def control_record(controller: record.Record) -> None:
    """Compute motor commands from estimate and demand of a record (1,)."""
    control(controller[0])


@kernel
def _detect(c: record.Fields) -> bool:
    """Return True if the vehicle has just lifted off, or has come to rest on the ground."""
    thrust, down_m_s = c.output[_THRUST], c.output[_VELOCITY + 2]
    if c.detecting == record.LIFT_OFF:
        # A new flight starts without time at rest.
        c.still_since_us = -1
        return lifts_off(c.state, thrust, c.land)
    if c.detecting != record.LANDING:
        return False
    # Time at rest counts only while the setpoint descends.
    if down_m_s <= 0.0 or not rests(c.state, thrust, c.land):
        c.still_since_us = -1
        return False
    if c.still_since_us < 0:
        c.still_since_us = c.time_us
    return c.time_us - c.still_since_us >= c.land[0]


@kernel
def detect_record(controller: record.Record) -> bool:
    """Return True if the vehicle of a record (1,) has just lifted off, or come to rest."""
    return _detect(controller[0])


@kernel
def command(c: record.Fields, flown: record.Fields) -> None:
    """Compute and log the motor commands of a tick, and update the land detector.

    Writes a row of the log (`record.FLOWN_TICK`), except for the aircraft's battery.
    """
    control(c)
    log_flown(c, flown)
    # Detection uses the output of this tick.
    c.detected = 1 if _detect(c) else 0


@kernel
def log_flown(c: record.Fields, flown: record.Fields) -> None:
    """Log a flight controller in a tick (`record.FLOWN_TICK`), except for the battery."""
    flown.time_us, flown.healthy = c.time_us, c.healthy
    for i in range(es.ROW_SIZE):
        flown.state[i] = c.state[i]
    for i in range(3):
        flown.accel[i], flown.gyro[i], flown.mag[i] = c.accel[i], c.gyro[i], c.mag[i]
        flown.gps_position[i], flown.gps_velocity[i] = c.gps_position[i], c.gps_velocity[i]
    flown.pressure_hpa, flown.temperature_c = c.pressure_hpa, c.temperature_c
    flown.demand_kind = c.demand_kind
    for i in range(_THRUST + 1):
        flown.demand[i], flown.output[i] = c.demand[i], c.output[i]
    for i in range(4):
        flown.motors[i] = c.motors[i]


# --- aircraft


@kernel
def push(a: record.Fields, motors: dynamics.Speeds, wind: frames.Vector) -> tuple[Vec, Vec, Vec]:
    """Advance the rotors by a tick; return centre of mass, force and torque as `actuate`."""
    s = a.speeds
    speeds, here, pushed, torque = dynamics.actuate(
        (s[0], s[1], s[2], s[3]), motors, a.motion, wind, a.airframe, a.rotor_lag
    )
    for i in range(4):
        a.speeds[i] = speeds[i]
    # The thrust carries a part of the weight; the floor bears the rest.
    weight_n = airframe_of(a.airframe).mass * GRAVITY_M_S2
    pressing_n = weight_n + pushed[2]
    bears_n = HOLD_SHARE * FRICTION * pressing_n
    # The floor holds against lift-off, sliding, tipping and turning about the vertical axis.
    a.held = (
        pressing_n > LIGHT_SHARE * weight_n
        and math.hypot(pushed[0], pushed[1]) <= bears_n
        and math.hypot(torque[0], torque[1]) <= HOLD_SHARE * pressing_n * a.footing_m
        and abs(torque[2]) <= bears_n * a.footing_m
    )
    return here, pushed, torque


@kernel
def finish(a: record.Fields, after: frames.Vector, wind: frames.Vector, standing: bool) -> None:
    """Apply the motion after a tick (16,): advance time and drain the battery."""
    f, s = a.acceleration, a.speeds
    a.power_w, felt, reading, a.charge = dynamics.absorb(
        a.motion,
        after,
        wind,
        (s[0], s[1], s[2], s[3]),
        standing,
        (f[0], f[1], f[2]),
        a.charge,
        a.airframe,
        a.power_model,
        a.pack,
        a.computer_w,
        a.tick_s,
    )
    for i in range(3):
        a.acceleration[i] = felt[i]
    for i in range(4):
        a.battery[i] = reading[i]
    for i in range(dynamics.WIDTH):
        # Copy last: `absorb` compares the motion before and after.
        a.motion[i] = after[i]
    a.ticks += 1
    # From the tick count: periods of some rates are not whole microseconds.
    a.time_us = a.start_us + a.ticks * US_PER_S // a.rate_hz


@kernel
def _turning(a: record.Fields, c: record.Fields) -> dynamics.Speeds:
    """Return the motor commands; zero with an empty battery."""
    if a.charge <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    return c.motors[0], c.motors[1], c.motors[2], c.motors[3]


@kernel
def _nearing_m(a: record.Fields) -> float:
    """Return the maximum approach of any part to any object in a tick [m]."""
    v, w = dynamics.velocity(a.motion), dynamics.rates(a.motion)
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    spin = math.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    # Speed of the vehicle, of moving objects, and of its outermost part by rotation.
    nearing: float = a.tick_s * (a.closing_m_s + speed + a.reach_m * spin)
    return nearing


@kernel
def _is_clear(a: record.Fields) -> bool:
    """Return True if contacts are impossible in the coming tick."""
    return bool(a.room_m > a.clear_m + _nearing_m(a))


@kernel
def is_clear_record(aircraft: record.Record) -> bool:
    """Return True if contacts are impossible in the coming tick of a record (1,)."""
    return _is_clear(aircraft[0])


@kernel
def _glide(a: record.Fields, c: record.Fields, wind: frames.Vector, after: frames.Vector) -> None:
    """Move an aircraft without contact by one tick; `after` (16,) is scratch."""
    before, dt = a.motion, a.tick_s
    here, thrust, torque = push(a, _turning(a, c), wind)
    q, airframe = dynamics.quaternion(before), airframe_of(a.airframe)
    # Torque in body axes, where the inertia is constant.
    turn = rotate(conjugate(q), torque)
    v, spin = accelerate(
        dynamics.velocity(before), q, dynamics.rates(before), thrust, turn, airframe, dt
    )
    p, q_new, omega = drift(here, v, q, spin, dt)
    # Keep w >= 0, as the estimate does.
    if q_new[0] < 0.0:
        q_new = (-q_new[0], -q_new[1], -q_new[2], -q_new[3])
    dynamics.write(p, v, q_new, omega, before, dt, after)
    finish(a, after, wind, False)
    # Contact room shrinks by the largest possible approach; Python measures it again at zero.
    a.room_m -= _nearing_m(a)


@kernel
def log(a: record.Fields, truth: record.Fields) -> None:
    """Log the aircraft after a tick (`record.TRUE_TICK`)."""
    truth.time_us, truth.power_w, truth.charge = a.time_us, a.power_w, a.charge
    for i in range(dynamics.WIDTH):
        truth.motion[i] = a.motion[i]


@kernel
def _rest(
    a: record.Fields, motors: dynamics.Speeds, wind: frames.Vector, after: frames.Vector
) -> None:
    """Keep an aircraft at rest for one tick; `after` (16,) is scratch."""
    push(a, motors, wind)
    row = a.motion
    for i in range(dynamics.WIDTH):
        after[i] = row[i]
    # At rest the accelerometer measures the floor's push: -g in body axes.
    after[13], after[14], after[15] = rotate(
        conjugate(dynamics.quaternion(row)), (0.0, 0.0, -GRAVITY_M_S2)
    )
    finish(a, after, wind, True)
    a.room_m -= _nearing_m(a)


@kernel
def rest_record(aircraft: record.Record, motors: dynamics.Speeds, wind: frames.Vector) -> None:
    """Keep the aircraft of a record (1,) at rest for one tick."""
    _rest(aircraft[0], motors, wind, np.empty(dynamics.WIDTH))


@kernel
def push_record(
    aircraft: record.Record, motors: dynamics.Speeds, wind: frames.Vector
) -> tuple[Vec, Vec, Vec]:
    """Advance the rotors of a record (1,) by a tick; return the results of `actuate`."""
    return push(aircraft[0], motors, wind)


@kernel
def finish_record(
    aircraft: record.Record, after: frames.Vector, wind: frames.Vector, standing: bool
) -> None:
    """Apply the motion after a tick (16,) to a record (1,); see `finish`."""
    finish(aircraft[0], after, wind, standing)


# --- sensors


@kernel
def is_due(schedule: frames.Vector, time_us: int) -> bool:
    """Return True once per period of a sensor, given (rate [Hz], next sample [µs], period)."""
    if time_us < schedule[1]:
        return False
    rate = schedule[0]
    period = int(time_us * rate / US_PER_S)
    # Rounding may assign a time on a boundary to the period before.
    if (period + 1) * US_PER_S / rate <= time_us:
        period += 1
    # Periods are counted from zero, so that rounding does not add up.
    schedule[2], schedule[1] = period, (period + 1) * US_PER_S / rate
    return True


@kernel
def sense(
    a: record.Fields,
    sample: record.Fields,
    inertial: frames.Vector,
    compass: frames.Vector,
    barometer: frames.Vector,
    gps: frames.Vector,
) -> None:
    """Sample the accelerometer, the gyro, and the slower sensors that are due.

    Updates biases, drifts and schedules of an aircraft, and writes its sample. White noise:
    inertial (n, 12) for accelerometer, gyro, their biases; compass (n, 3); barometer (n, 2) for
    drift and sample; GPS (n, 9) for correlated error, position, velocity.
    """
    row, sigma, now_us = a.motion, a.imu_sigma, a.time_us
    # One row of white noise per sample, drawn in blocks by Python.
    white = inertial[a.noise_at[_INERTIAL]]
    a.noise_at[_INERTIAL] += 1
    felt, turning = dynamics.force(row), dynamics.rates(row)
    # Biases are random walks; each sample adds its own white noise.
    for i in range(3):
        a.accel_bias[i] += sigma[6 + i] * white[6 + i]
        a.gyro_bias[i] += sigma[9 + i] * white[9 + i]
        sample.accel[i] = felt[i] + a.accel_bias[i] + sigma[i] * white[i]
        sample.gyro[i] = turning[i] + a.gyro_bias[i] + sigma[3 + i] * white[3 + i]
    sample.time_us, sample.measured, sample.battery_left = now_us, 0, a.battery[3]
    sample.temperature_c = atmosphere.temperature_c(_HOME_M - row[2])
    if is_due(a.mag_rate, now_us):
        white = compass[a.noise_at[_COMPASS]]
        a.noise_at[_COMPASS] += 1
        # The compass measures the earth's field in body axes.
        field = frames.MAGNETIC_FIELD_NED
        seen = rotate(conjugate(dynamics.quaternion(row)), (field[0], field[1], field[2]))
        for i in range(3):
            sample.mag[i] = seen[i] + a.mag_sigma * white[i]
        sample.measured |= record.MAG
    if is_due(a.baro_rate, now_us):
        white = barometer[a.noise_at[_BAROMETER]]
        a.noise_at[_BAROMETER] += 1
        # Drift is a random walk, noise is white; both in pascal.
        a.baro_drift_pa += a.baro_step_pa * white[0]
        off_pa = a.baro_drift_pa + a.baro_noise_pa * white[1]
        sample.pressure_hpa = atmosphere.pressure_hpa(_HOME_M - row[2]) + off_pa / PA_PER_HPA
        sample.measured |= record.PRESSURE
    if a.gps_fitted != 0 and is_due(a.gps_rate, now_us):
        white = gps[a.noise_at[_GPS]]
        a.noise_at[_GPS] += 1
        for i in range(3):
            # Correlated error: a first-order Gauss-Markov process.
            a.gps_error[i] = a.gps_keep * a.gps_error[i] + a.gps_drive * white[i]
            sample.gps_position[i] = row[i] + a.gps_error[i] + a.gps_noise_m[i] * white[3 + i]
            sample.gps_velocity[i] = row[3 + i] + a.gps_noise_m_s * white[6 + i]
        sample.measured |= record.GPS


@kernel
def sense_record(
    aircraft: record.Record,
    sample: record.Record,
    inertial: frames.Vector,
    compass: frames.Vector,
    barometer: frames.Vector,
    gps: frames.Vector,
) -> None:
    """Sample the sensors of records (1,); see `sense`."""
    sense(aircraft[0], sample[0], inertial, compass, barometer, gps)


# --- estimator


@kernel
def _watch(c: record.Fields, row: int) -> None:
    """Store the time of a new measurement of a sensor."""
    c.watch[row, record.SEEN] = c.watch[row, record.CHANGED] = c.time_us
    if c.watch[row, record.FIRST] < 0:
        c.watch[row, record.FIRST] = c.time_us


@kernel
def _copied(new: frames.Vector, old: frames.Vector) -> bool:
    """Copy a sample (3,); return True if it differs from the previous sample."""
    changed = False
    for i in range(3):
        # No early exit: all three values must be copied.
        changed = changed or new[i] != old[i]
        old[i] = new[i]
    return changed


@kernel
def _take_inertial(c: record.Fields, sample: record.Fields) -> None:
    """Read the measurements of every tick."""
    c.time_us, c.temperature_c = sample.time_us, sample.temperature_c
    c.battery_left = sample.battery_left
    for i in range(3):
        c.accel[i], c.gyro[i] = sample.accel[i], sample.gyro[i]


@kernel
def _take(c: record.Fields, sample: record.Fields) -> int:
    """Read the samples of the slower sensors; return the bits of repeated samples."""
    repeated = 0
    if sample.measured & record.MAG:
        if _copied(sample.mag, c.mag):
            _watch(c, record.MAG_ROW)
        else:
            repeated |= record.MAG
    if sample.measured & record.PRESSURE:
        # Equality of floats is meant: a frozen sensor repeats its value exactly.
        if sample.pressure_hpa != c.pressure_hpa:
            _watch(c, record.BARO_ROW)
        else:
            repeated |= record.PRESSURE
        c.pressure_hpa = sample.pressure_hpa
    if sample.measured & record.GPS:
        moved = _copied(sample.gps_position, c.gps_position)
        # `_copied` first: `or` must not skip the copy.
        if _copied(sample.gps_velocity, c.gps_velocity) or moved:
            _watch(c, record.GPS_ROW)
        else:
            repeated |= record.GPS
    return repeated


@kernel
def fuse_gps(c: record.Fields, sample: record.Fields) -> bool:
    """Fuse a fix. Return False, without changes, if Python must check it first."""
    if c.gps == record.OFF:
        return True
    known = not math.isnan(c.origin[0])
    # A receiver that has been rejected for long may need a heading reset.
    recent = c.gps_horizontal_us >= 0 and c.time_us - c.gps_horizontal_us < REFUSED_US
    if c.gps != record.TRUSTED or not (known and recent):
        return False
    s, p, r_p, r_v = c.state, c.covariance, c.gps_variance[0], c.gps_variance[1]
    deviations = np.empty(3)
    # Test all axes before any change: Python repeats the whole fix.
    for i in range(3):
        off = sample.gps_velocity[i] - s[es.V + i]
        deviations[i] = off / math.sqrt(p[es.VEL + i, es.VEL + i] + r_v)
        # False for NaN, too.
        if not abs(deviations[i]) <= FAR:
            return False
    # The sample is relative to HOME; the filter's origin may differ.
    here = frames.local_to_geodetic(sample.gps_position, frames.HOME)
    place = frames.geodetic_to_local(here, frames.Geodetic(c.origin[0], c.origin[1], c.origin[2]))
    north, east, down = sample.gps_velocity[0], sample.gps_velocity[1], sample.gps_velocity[2]
    # Same order as `Estimator._fuse_gps`, so both give identical results.
    observe(c, north, east, math.sqrt(r_v))
    note_velocity(c, deviations, s[es.ACCELERATION : es.SIGMA])
    z, r = c.innovation4, c.variance4
    z[0], z[1], z[2], z[3] = place[0] - s[0], place[1] - s[1], north - s[es.V], east - s[es.V + 1]
    r[0] = r[1] = r_p
    r[2] = r[3] = r_v
    ratio = fuse(s, p, z, c.gps_horizontal_h, r)
    s[es.RATIO] = ratio
    if ratio <= 1.0:
        c.gps_horizontal_us = c.time_us
    # The horizontal fusion has changed s: the vertical innovation uses the new state.
    z, r = c.innovation2, c.variance2
    z[0], z[1] = place[2] - s[2], down - s[es.V + 2]
    # A receiver's vertical accuracy is about half its horizontal accuracy.
    r[0], r[1] = max(sample.gps_epv_m, math.sqrt(r_p)) ** 2, r_v
    ratio = fuse(s, p, z, c.gps_vertical_h, r)
    s[es.RATIO + 3] = ratio
    if ratio <= 1.0:
        c.gps_vertical_us = c.time_us
    return True


@kernel
def fuse_pressure(c: record.Fields) -> None:
    """Fuse the barometer's sample."""
    height = atmosphere.altitude_m(c.pressure_hpa) - c.baro_origin_m
    c.innovation[0] = height + c.state[es.P + 2] - c.state[es.BARO_OFFSET]
    c.variance[0] = c.baro_variance
    ratio = fuse(c.state, c.covariance, c.innovation, c.baro_h, c.variance)
    c.state[es.RATIO + 1] = ratio
    if ratio <= 1.0:
        c.baro_fused_us = c.time_us


@kernel
def fuse_heading(c: record.Fields) -> bool:
    """Fuse the compass's sample; return False if Python must check its innovation first."""
    if c.compass == record.OFF:
        return True
    if c.compass == record.SUSPECT:
        return False
    # At steep pitch the heading is not observable: nothing to fuse, nothing to check.
    if not es.observe_heading(
        c.state, c.mag, frames.MAGNETIC_DECLINATION, HEADING_BY_TURN_NED, c.innovation, c.heading_h
    ):
        return True
    # The variance of the innovation decides whether it is calm.
    total = spread(c.covariance, c.heading_h[0], np.empty(es.N_STATES)) + c.heading_variance
    # False for NaN, too.
    if not abs(c.innovation[0]) <= CALM_RATIO * es.GATE * math.sqrt(total):
        return False
    c.variance[0] = c.heading_variance
    c.state[es.RATIO + 2] = fuse(c.state, c.covariance, c.innovation, c.heading_h, c.variance)
    c.heading_fused_us = c.time_us
    return True


@kernel
def _await_alignment(c: record.Fields, sample: record.Fields) -> bool:
    """Add a sample at rest to the sums; return True if Python must evaluate the sums."""
    _take_inertial(c, sample)
    _take(c, sample)
    add(c, sample.measured)
    # The first fix is a separate event, see `ALIGN`.
    first_fix = sample.measured & record.GPS != 0 and c.rest_count[FIXES] == 1
    return first_fix or c.time_us - c.rest_since_us >= ALIGN_US


@large_kernel
def estimate(c: record.Fields, sample: record.Fields) -> int:
    """Predict with the newest IMU sample, and fuse the other measurements of the tick.

    Returns the bits of the measurements that Python must fuse, as in `measured`, and of repeated
    samples.
    """
    # The IMU runs every tick, so most ticks end after the prediction.
    _take_inertial(c, sample)
    predict(c.state, c.covariance, c.process_noise, c.transition, c.gyro, c.accel, TICK_S)
    feel(c)
    if sample.measured == 0:
        return 0
    repeated = _take(c, sample)
    # Python decides whether a repeated sample is a fault or normal for this sensor.
    if repeated != 0:
        return sample.measured | repeated << REPEATED_BITS
    if sample.measured & record.GPS and not fuse_gps(c, sample):
        # Nothing is fused yet: Python fuses all of the tick in the usual order.
        return int(sample.measured)
    if sample.measured & record.PRESSURE:
        fuse_pressure(c)
    if sample.measured & record.MAG and not fuse_heading(c):
        return record.MAG
    return 0


@kernel
def settle(c: record.Fields) -> bool:
    """Update the estimator's health after all fusion of a tick; return True if it has changed."""
    healthy = 1 if es.converged(c.state, c.covariance) else 0
    changed: bool = healthy != c.healthy
    c.healthy = healthy
    return changed


@kernel
def begin_touch(
    controller: record.Record, aircraft: record.Record, flown: record.Record, wind: frames.Vector
) -> tuple[Vec, Vec, Vec]:
    """Start a tick of records (1,) in which another engine moves the body.

    Returns centre of mass, force and torque as `actuate`.
    """
    a, c = aircraft[0], controller[0]
    command(c, flown[0])
    # The battery belongs to the aircraft, so `command` does not log it.
    for i in range(4):
        flown[0].battery[i] = a.battery[i]
    return push(a, _turning(a, c), wind)


@kernel
def end_touch(
    aircraft: record.Record,
    sample: record.Record,
    controller: record.Record,
    after: frames.Vector,
    wind: frames.Vector,
    standing: bool,
    inertial: frames.Vector,
    compass: frames.Vector,
    barometer: frames.Vector,
    gps: frames.Vector,
    truth: record.Record,
) -> int:
    """End a tick of records (1,), given the motion (16,) after it: measure and estimate.

    Returns the event: `ALIGN`, `FUSE`, `HEALTH` or `NONE`.
    """
    a, c = aircraft[0], controller[0]
    finish(a, after, wind, standing)
    log(a, truth[0])
    sense(a, sample[0], inertial, compass, barometer, gps)
    if c.aligned == 0:
        return ALIGN if _await_alignment(c, sample[0]) else NONE
    # Python finishes the fusion, then settles the health itself.
    c.left = estimate(c, sample[0])
    if c.left != 0:
        return FUSE
    return HEALTH if settle(c) else NONE


@kernel
def log_flown_record(controller: record.Record, flown: record.Record) -> None:
    """Log a flight controller's record (1,) in a tick; see `log_flown`."""
    log_flown(controller[0], flown[0])


@kernel
def log_record(aircraft: record.Record, truth: record.Record) -> None:
    """Log an aircraft's record (1,) after a tick; see `log`."""
    log(aircraft[0], truth[0])


@kernel
def settle_record(controller: record.Record) -> bool:
    """Update the estimator's health in a record (1,); return True if it has changed."""
    return settle(controller[0])


# --- many ticks


@large_kernel
def stretch(
    aircraft: record.Record,
    sample: record.Record,
    controller: record.Record,
    ticks: int,
    inertial: frames.Vector,
    compass: frames.Vector,
    barometer: frames.Vector,
    gps: frames.Vector,
    wind: frames.Vector,
    truths: record.Record,
    flown: record.Record,
) -> int:
    """Fly up to `ticks` ticks, at least 1, at a constant demand, and update the three records (1,).

    `inertial` to `gps` are noise (`sense`), `wind` (n, 3) is NED [m/s] in the coming ticks; a
    single row is constant wind. Writes the logs of aircraft and flight controller (ticks,).

    Returns complete ticks and event: `ticks << EVENT_BITS | event`. After `FUSE` one more tick is
    flown and logged, and its measurements wait in the sample.
    """
    a, seen, c = aircraft[0], sample[0], controller[0]
    after, at, steady = np.empty(dynamics.WIDTH), a.noise_at, len(wind) == 1
    for k in range(ticks):
        # One tick needs at most one row of each block: check all before anything moves.
        if (
            at[_INERTIAL] >= len(inertial)
            or at[_COMPASS] >= len(compass)
            or at[_BAROMETER] >= len(barometer)
            or at[_GPS] >= len(gps)
            or (not steady and at[_WIND] >= len(wind))
        ):
            return k << EVENT_BITS | NOISE
        # The take-off has ended: Python decides before this tick.
        if climb_if_due(c):
            return k << EVENT_BITS | CLIMBED
        # A resting vehicle that the floor no longer holds needs the contact physics.
        if not _is_clear(a) or (a.resting != 0 and a.held == 0):
            return k << EVENT_BITS | ROOM
        row, charged = flown[k], a.charge > 0.0
        command(c, row)
        for i in range(4):
            row.battery[i] = a.battery[i]
        air = wind[0 if steady else at[_WIND]]
        if not steady:
            at[_WIND] += 1
        if a.resting != 0:
            _rest(a, _turning(a, c), air, after)
        else:
            _glide(a, c, air, after)
        log(a, truths[k])
        sense(a, seen, inertial, compass, barometer, gps)
        if c.aligned == 0:
            # Before alignment nothing can be fused.
            if _await_alignment(c, seen):
                return (k + 1) << EVENT_BITS | ALIGN
            continue
        c.left = estimate(c, seen)
        if c.left != 0:
            # Tick k is logged but not complete: `k`, not `k + 1`.
            return k << EVENT_BITS | FUSE
        if settle(c):
            return (k + 1) << EVENT_BITS | HEALTH
        if c.detected != 0:
            return (k + 1) << EVENT_BITS | DETECTED
        # Only the tick that empties the battery ends the stretch.
        if charged and a.charge <= 0.0:
            return (k + 1) << EVENT_BITS | EMPTY
    return ticks << EVENT_BITS | NONE
