"""Sensor, motor, battery, wind and camera faults, inserted only in episodes with faults.

A sensor that is off has None in the sample. Accelerometer and gyro are never None: flight
controllers count time by their samples. If one is off, it repeats its last sample like a stuck
sensor.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.frame import Frame
from airl_mav.camera.noise import DepthNoise, noisy_frame
from airl_mav.camera.render import Motion
from airl_mav.core import constants, frames
from airl_mav.faults import MOTORS, NOISE_SEED, SENSORS, Fault, gust_share
from airl_mav.profiles.vehicle import Battery, SensorNoise, Sensors, VehicleProfile
from airl_mav.vehicle.airframe import Airframe, command_for, steady_speed
from firmware_sim import interfaces
from firmware_sim.engine import dynamics, ticks
from firmware_sim.fault_timeline import Acting, FaultTimeline
from firmware_sim.plant.camera import OnboardCamera
from firmware_sim.plant.plant import Blowing, Plant


def motor_effects(acting: Sequence[Acting]) -> tuple[dict[int, float], dict[int, float]]:
    """Return the remaining share of thrust, and the factor on the time constant, of faulty motors.

    Both by index of the motor, from 0.
    """
    left: dict[int, float] = {}
    slow: dict[int, float] = {}
    for _, fault, *_ in acting:
        motor = MOTORS.index(fault.part)
        if fault.kind == "slow":
            # Several faults of one motor multiply: each scales what the others leave.
            slow[motor] = slow.get(motor, 1.0) * fault.amount
        else:
            left[motor] = left.get(motor, 1.0) * _share(fault)
    return left, slow


def _share(fault: Fault) -> float:
    if fault.kind == "off":
        return 0.0
    return 1.0 + fault.amount if fault.kind == "mismatch" else fault.amount


def weakened(
    controls: interfaces.ActuatorControls, left: Mapping[int, float], thrust_curve: float
) -> interfaces.ActuatorControls:
    """Return commands that give healthy motors the thrust of failing motors.

    `left` is the remaining share of thrust of each failing motor, by index. A share above 1 raises
    the thrust, up to the motor's maximum.
    """
    motors = list(controls.motors)
    for index, share in left.items():
        # Thrust is proportional to the square of the speed, the command is not: convert both ways.
        thrust = min(1.0, share * steady_speed(motors[index], thrust_curve) ** 2)
        motors[index] = command_for(thrust, thrust_curve)
    first, second, third, fourth = motors
    return controls._replace(motors=(first, second, third, fourth))


def slowed(
    controls: interfaces.ActuatorControls,
    slow: Mapping[int, float],
    speeds: Sequence[float],
    lag: float,
    thrust_curve: float,
) -> interfaces.ActuatorControls:
    """Return commands that give healthy motors the speeds of slow motors.

    Over a tick, a motor of time constant `k tau` keeps the share `lag^(1/k)` of its speed error, a
    healthy motor `lag` = exp(-dt / tau). The healthy motor reaches the same speed when commanded
    exactly the share (1 - lag^(1/k)) / (1 - lag) of the change. `slow` is the factor k of each slow
    motor by index; `speeds` are the present rotor speeds as shares of the speed at full command.
    """
    motors = list(controls.motors)
    for index, factor in slow.items():
        now, target = speeds[index], steady_speed(motors[index], thrust_curve)
        reached = now + (target - now) * (1.0 - lag ** (1.0 / factor)) / (1.0 - lag)
        motors[index] = command_for(reached * reached, thrust_curve)
    first, second, third, fourth = motors
    return controls._replace(motors=(first, second, third, fourth))


def misread(
    reading: interfaces.BatterySample, acting: Sequence[Acting], battery: Battery
) -> interfaces.BatterySample:
    """Return the reading of a failing battery: empty if `off`, a lower voltage by `sag`."""
    for _, fault, *_ in acting:
        if fault.kind == "off":
            empty_v = battery.cells * battery.cell_empty_v
            reading = reading._replace(voltage_v=empty_v, remaining=0.0)
        # A sag is per cell, so that one fault fits batteries of any cell count.
        elif fault.kind == "sag":
            voltage_v = max(0.0, reading.voltage_v - battery.cells * fault.amount)
            reading = reading._replace(voltage_v=voltage_v)
    return reading


FIELDS = {
    "accel": "accel",
    "gyro": "gyro",
    "mag": "mag",
    "baro": "pressure_hpa",
    "gps": "gps",
    "vision": "odometry",
    "rangefinder": "distance",
    "flow": "flow",
}
"""Fields of `SensorSample` by sensor name."""

INERTIAL = ("accel", "gyro")

Effect = Callable[[Any, int], Any]
"""Effect of a fault on one sensor: maps value and time [µs] to the measured value; None = no sample
in this tick. May be stateful."""


def _off(value: Any, time_us: int) -> None:
    """Return no sample."""


@dataclass
class Stuck:
    """Stuck sensor: repeats the first sample of the fault at the sensor's rate."""

    sample: Any = None

    def __call__(self, value: Any, time_us: int) -> Any:
        """Return the held sample, or None without a sample in this tick."""
        del time_us
        if self.sample is None:
            self.sample = value
        return None if value is None else self.sample


class Late:
    """Delay of samples. With `always`, the newest delivered sample is repeated in between."""

    def __init__(self, delay_s: float, *, always: bool) -> None:
        self._delay_us = round(delay_s * constants.US_PER_S)
        self._always = always
        self._queue: deque[tuple[int, Any]] = deque()
        self._newest: Any = None

    def __call__(self, value: Any, time_us: int) -> Any:
        """Return the sample that is due now."""
        queue = self._queue
        if value is not None:
            queue.append((time_us + self._delay_us, value))
            # Until the first delayed sample arrives, an inertial sensor repeats the first one: the
            # flight controller requires a value in every tick.
            if self._newest is None:
                self._newest = value
        arrived = None
        # After a shortened delay several samples may be due: the newest wins.
        while queue and queue[0][0] <= time_us:
            arrived = self._newest = queue.popleft()[1]
        return self._newest if self._always else arrived


@dataclass
class Biased:
    """Error that is constant, or grows at a constant velocity."""

    offset: frames.Vector
    velocity: frames.Vector | None = None
    since_us: int = 0

    def __call__(self, value: Any, time_us: int) -> Any:
        """Return the value with the error."""
        if value is None:
            return None
        if self.velocity is None:
            return shifted(value, self.offset)
        return shifted(value, self.velocity * ((time_us - self.since_us) / constants.US_PER_S))


@dataclass
class Noisy:
    """White noise in addition to the sensor's noise."""

    sd: frames.Vector
    rng: np.random.Generator

    def __call__(self, value: Any, time_us: int) -> Any:
        """Return the value with additional noise."""
        del time_us
        if value is None:
            return None
        # One draw for position and velocity, so that the stream does not depend on the sample's
        # type.
        error = self.sd * self.rng.standard_normal(len(self.sd))
        moved = shifted(value, error[:3])
        if isinstance(moved, interfaces.GpsFix):
            return moved._replace(velocity_ned=moved.velocity_ned + error[3:])
        if isinstance(moved, interfaces.Odometry) and moved.velocity is not None:
            return moved._replace(velocity=moved.velocity + error[3:])
        return moved


def shifted(value: Any, offset: frames.Vector) -> Any:
    """Return a measured value with an error: NED for a fix, the pose's frame for a pose."""
    if isinstance(value, interfaces.GpsFix):
        return value._replace(position=frames.local_to_geodetic(offset, value.position))
    if isinstance(value, interfaces.Odometry):
        return value if value.position is None else value._replace(position=value.position + offset)
    if isinstance(value, interfaces.DistanceReading):
        return farther(value, offset.item(0))
    if isinstance(value, interfaces.FlowReading):
        # Flow is an integrated angle: a rate error grows with the interval. Quality 0 has no flow.
        error = offset * value.interval_s if value.quality > 0 else 0.0
        return value._replace(flow=value.flow + error)
    if isinstance(value, float):
        return value + offset.item(0)
    return value + offset


def farther(reading: interfaces.DistanceReading, error_m: float) -> interfaces.DistanceReading:
    """Return a range with an error, with quality 0 if it is outside the sensor's limits."""
    if reading.quality == 0:
        return reading
    distance_m = max(0.0, reading.distance_m + error_m)
    # Beyond its limits a range finder reports an invalid measurement, not a wrong distance.
    within = reading.least_m <= distance_m <= reading.greatest_m
    return reading._replace(distance_m=distance_m, quality=reading.quality if within else 0)


def noise_sd(part: str, profile: Sensors, tick_s: float) -> frames.Vector:
    """Return the sd of a sensor's noise; for a fix or a pose, position (3) and velocity (3)."""
    # Profiles give noise per base tick; white noise of shorter ticks has a larger deviation.
    white = math.sqrt(constants.TICK_S / tick_s)
    gps = profile.gps
    horizontal, speed = gps.horizontal_noise_m, gps.velocity_noise_m_s
    vision = profile.vision
    vision_sd = (0.0, 0.0)
    if vision is not None:
        vision_sd = vision.position_noise_m, vision.velocity_noise_m_s
    ranges, flow = profile.rangefinder, profile.optical_flow
    known: dict[str, list[float]] = {
        "accel": [profile.imu.accel_noise_m_s2 * white] * 3,
        "gyro": [profile.imu.gyro_noise_rad_s * white] * 3,
        "mag": [profile.magnetometer.noise_gauss] * 3,
        "baro": [profile.barometer.noise_pa / ticks.PA_PER_HPA],
        "gps": [horizontal, horizontal, gps.vertical_noise_m, speed, speed, speed],
        "vision": [vision_sd[0]] * 3 + [vision_sd[1]] * 3,
        "rangefinder": [0.0 if ranges is None else ranges.noise_m],
        "flow": [0.0 if flow is None else flow.noise_rad_s] * 2,
    }
    return np.array(known[part])


def effect_of(acting: Acting, profile: Sensors, tick_s: float, rng: np.random.Generator) -> Effect:
    """Return the effect of a sensor fault; `rng` is used by this fault only."""
    fault = acting.fault
    part, kind = fault.part, fault.kind
    # A missing inertial sample would stop the flight controller's loop: such a sensor repeats its
    # last value instead.
    if kind == "off" and part not in INERTIAL:
        return _off
    if kind in ("off", "stuck"):
        return Stuck()
    if kind == "delay":
        return Late(fault.amount, always=part in INERTIAL)
    if kind == "bias":
        return Biased(np.array(fault.value))
    if kind == "drift":
        velocity = np.array(fault.value)
        return Biased(np.zeros(3), velocity, acting.since_us)
    # `amount` is the ratio of total noise to the sensor's noise; their variances add.
    more = math.sqrt(max(0.0, fault.amount**2 - 1.0))
    return Noisy(more * noise_sd(part, profile, tick_s), rng)


def failed(
    sample: interfaces.SensorSample, effects: list[tuple[str, Effect]]
) -> interfaces.SensorSample:
    """Return a sample with all effects, given with sensor names, applied in order."""
    changed: dict[str, Any] = {}
    for part, effect in effects:
        name = FIELDS[part]
        # A second fault of a sensor acts on the output of the first.
        value = changed[name] if name in changed else getattr(sample, name)
        changed[name] = effect(value, sample.time_us)
    return sample._replace(**changed)


def gust_at(acting: Sequence[Acting], time_us: int) -> frames.Vector:
    """Return the wind (3,) NED [m/s] added by faults at a time [µs]."""
    total = np.zeros(3)
    for each in acting:
        share = 1.0
        if each.fault.kind == "gust":
            elapsed_us, whole_us = time_us - each.since_us, each.until_us - each.since_us
            share = gust_share(elapsed_us / constants.US_PER_S, whole_us / constants.US_PER_S)
        total += share * np.array(each.fault.value)
    return total


class Gusts:
    """Wind with the additional wind of faults."""

    def __init__(self, wind: Blowing) -> None:
        """Wrap the wind of the episode."""
        self.more: frames.Vector | None = None
        """Additional wind (3,) NED [m/s] in the next tick; None = no additional wind."""
        self._wind = wind

    def step(self) -> frames.Vector:
        """Advance one tick and return the wind (3,) NED [m/s]."""
        wind = self._wind.step()
        return wind if self.more is None else wind + self.more


class FailingParts:
    """Fault layer between the plant and the flight controller.

    Works with any flight controller: the built-in autopilot, or real firmware behind its simulator
    interface.
    """

    def __init__(
        self,
        controller: interfaces.FlightController,
        plant: Plant,
        vehicle: VehicleProfile,
        timeline: FaultTimeline,
    ) -> None:
        """Insert the layer between controller and plant, without active faults.

        Faults add gusts to the plant's wind and reduce its battery charge. The vehicle profile
        contains the sensor noise, the battery and the motors' thrust curve.
        """
        self._controller = controller
        self._plant = plant
        self._vehicle = vehicle
        self._curve = Airframe.from_profile(vehicle).thrust_curve
        self._tick_s = 1.0 / controller.rate_hz
        self._timeline = timeline
        self._memories: dict[int, Effect] = {}
        self._effects: list[tuple[str, Effect]] = []
        self._battery: list[Acting] = []
        self._left: dict[int, float] = {}
        self._slow: dict[int, float] = {}
        self._turning: dynamics.Speeds | None = None
        """Latest effective motor commands; None = those of the flight controller."""
        self._gusts = Gusts(plant.wind)
        plant.wind = self._gusts
        self._wind: list[Acting] = []
        self._dropped: set[int] = set()
        timeline.on_change(self._rearrange)

    def step(self, sample: interfaces.SensorSample) -> interfaces.ActuatorControls:
        """Advance the flight controller by the altered sample; return effective motor commands."""
        # Faults start before the sample is altered, so they act from this tick on.
        self._timeline.update(sample.time_us, self._controller.flight)
        if self._effects:
            sample = failed(sample, self._effects)
        if self._battery:
            reading = misread(sample.battery, self._battery, self._vehicle.battery)
            sample = sample._replace(battery=reading)
        if self._wind:
            self._gusts.more = gust_at(self._wind, sample.time_us)
        # ESC feedback must show the failing motors, otherwise motor failure could not be detected.
        if self._turning is not None:
            sample = sample._replace(esc_outputs=self._turning)
        controls = self._controller.step(sample)
        if not (self._left or self._slow):
            self._turning = None
            return controls
        if self._left:
            controls = weakened(controls, self._left, self._curve)
        if self._slow:
            plant = self._plant
            controls = slowed(
                controls, self._slow, plant.rotor_speeds, plant.rotor_lag, self._curve
            )
        self._turning = controls.motors
        return controls

    def _rearrange(self) -> None:
        timeline, before = self._timeline, self._memories
        sensors = timeline.acting(*SENSORS)
        self._memories = {
            # Effects with a state (held samples, queues) continue when another fault changes.
            each.number: before.get(each.number) or self._effect_of(each)
            for each in sensors
        }
        self._effects = [(each.fault.part, self._memories[each.number]) for each in sensors]
        self._left, self._slow = motor_effects(timeline.acting(*MOTORS))
        battery = timeline.acting("battery")
        for each in battery:
            # A drop removes charge once, however often the set of faults changes.
            if each.fault.kind == "drop" and each.number not in self._dropped:
                self._dropped.add(each.number)
                left = self._plant.battery_remaining - each.fault.amount
                self._plant.battery_remaining = max(0.0, left)
        self._battery = [each for each in battery if each.fault.kind != "drop"]
        self._wind = timeline.acting("wind")
        # The last gust must not remain after its fault has ended.
        if not self._wind:
            self._gusts.more = None

    def _effect_of(self, acting: Acting) -> Effect:
        rng = self._timeline.generator(acting.number)
        return effect_of(acting, self._vehicle.sensors, self._tick_s, rng)


class FailingCamera:
    """Camera with faults, inserted only in episodes with faults."""

    def __init__(self, camera: OnboardCamera, timeline: FaultTimeline, seed: int) -> None:
        """Wrap a healthy camera, with the faults and the seed of the episode."""
        self._camera = camera
        self._timeline = timeline
        self._seed = seed
        self._acting: list[Acting] = []
        self._frozen: Frame | None = None
        self._late: deque[tuple[int, Frame]] = deque()
        timeline.on_change(self._rearrange)

    @property
    def next_us(self) -> int:
        """Simulated time of the next exposure or delayed frame [µs]."""
        next_us = self._camera.next_us
        return min(next_us, self._late[0][0]) if self._late else next_us

    def restart(self, time_us: int) -> None:
        """Begin an episode at `time_us` [µs]."""
        # Frames of the previous episode must not arrive in this one.
        self._late.clear()
        self._camera.restart(time_us)

    def offer(self, time_us: int, motion: Motion, publish: Callable[[Frame], None]) -> None:
        """Pass due frames to `publish`; see `OnboardCamera.offer`."""
        if time_us >= self._camera.next_us:
            self._camera.offer(time_us, motion, lambda frame: self._take(frame, publish))
        while self._late and self._late[0][0] <= time_us:
            publish(self._late.popleft()[1])

    def skip_unread(self, read_us: int) -> None:
        """Skip nothing: a delayed or frozen frame may be read later."""

    def _take(self, frame: Frame, publish: Callable[[Frame], None]) -> None:
        delay_us = 0
        for each in self._acting:
            kind = each.fault.kind
            if kind == "off":
                return
            if kind == "delay":
                delay_us += round(each.fault.amount * constants.US_PER_S)
            elif kind == "noise":
                noise = DepthNoise(None, SensorNoise(depth_noise=each.fault.amount))
                # A separate stream per fault: a further fault must not change the noise of the
                # others.
                seed = NOISE_SEED * (each.number + 1) + self._seed
                depth = noisy_frame(frame.depth_mm, noise, seed, frame.sequence)
                frame = _showing(frame, depth, frame.jpeg)
            else:  # stuck
                if self._frozen is None:
                    self._frozen = frame
                frame = _showing(frame, self._frozen.image, self._frozen.jpeg)
        if delay_us or self._late:
            # A camera's frames arrive in order: a later frame must not overtake.
            due_us = frame.capture_time_us + delay_us
            self._late.append((max(due_us, self._late[-1][0]) if self._late else due_us, frame))
        else:
            publish(frame)

    def _rearrange(self) -> None:
        self._acting = self._timeline.acting("camera")
        # The next stuck fault freezes a new frame.
        if all(each.fault.kind != "stuck" for each in self._acting):
            self._frozen = None


def _showing(frame: Frame, image: NDArray[Any], jpeg: bytes | None) -> Frame:
    """Return a copy of a frame with another image of the main camera."""
    picture = image, frame.intrinsics, jpeg, frame.further
    return Frame(frame.sequence, frame.capture_time_us, *picture)
