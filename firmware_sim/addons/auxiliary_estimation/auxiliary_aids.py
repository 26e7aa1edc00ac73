"""Fusion of external vision, ranges and optical flow beside GPS, barometer and compass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from airl_mav.core import constants, frames
from firmware_sim.addons.auxiliary_estimation.external_vision import Control, ExternalVision
from firmware_sim.addons.auxiliary_estimation.optical_flow import OpticalFlowFusion
from firmware_sim.addons.auxiliary_estimation.range_finder import Aids, RangeFinder
from firmware_sim.addons.auxiliary_estimation.terrain_filter import TerrainFilter
from firmware_sim.autopilot import error_state as es
from firmware_sim.autopilot.estimator import Aiding, Estimator
from firmware_sim.interfaces import DistanceReading, FlowReading, Odometry, Received, SensorSample

_JUDGED_EVERY_US = constants.US_PER_S // 10
"""Interval of velocity checks by `Consistency`, the sample period of a typical GPS [µs]."""

_GROUND_STEPS, _GROUND_STEP_US = 30, 50_000
"""Number of ranges on the ground and in the air in the warm-up, and their interval [µs]; together
longer than EKF2_RNG_QLTY_T."""

VEHICLES_SENSOR, CLIENTS_SENSOR = 0, 1
"""Source ids of ranges."""


class AuxiliaryAids(Aiding):
    """Sequence of external vision, ranges and optical flow."""

    def __init__(self, estimator: Estimator) -> None:
        """Start without measurements."""
        self._estimator = estimator
        self.vision = ExternalVision(estimator, self._judge)
        """Fusion of poses from an external estimator."""
        estimator.horizons.append(self.vision.horizon)
        self.range: RangeFinder | None = None
        """Range fusion for the height above ground; None before the first range or flow reading."""
        self.flow: OpticalFlowFusion | None = None
        """Optical flow fusion; None before the first reading."""
        self._judged_us = 0
        """Time of the last check of external vision velocity against the inertial sensors [µs]."""

    @staticmethod
    def warm_up(value: Callable[[str], float]) -> None:
        """Fuse ranges on the ground and in the air: any client may send them at any time."""
        state, n = es.new_state(), es.N_STATES
        terrain = TerrainFilter(es.KernelFilter(np.diag(es.INITIAL_SIGMA**2), np.zeros(n)))
        finder = RangeFinder(value, state, terrain, 0)
        aids = Aids(horizontal=True, vertical_speed=True, height_us=0)
        for step in range(1, 2 * _GROUND_STEPS):
            now_us = step * _GROUND_STEP_US
            terrain.predict(state, np.zeros(3), np.array([0.0, 0.0, -constants.GRAVITY_M_S2]))
            finder.take(DistanceReading(0.5, 0.1, 12.0), now_us, CLIENTS_SENSOR)
            finder.step(now_us, lambda: aids, flying=step > _GROUND_STEPS)

    def step(self, sample: SensorSample) -> None:
        """Fuse a tick's sample, after GPS, barometer and compass."""
        now_us, flying = sample.time_us, self._estimator.flying
        if sample.odometry is not None:
            self._see(sample.odometry)
        elif self.vision.fused:
            # Without a new pose only the timeout of vision is checked.
            self.vision.look(now_us)
        if sample.distance is not None:
            self._measure(sample.distance, VEHICLES_SENSOR)
        # Ranges are fused before flow, which needs the height above ground.
        if self.range is not None:
            self.range.step(now_us, self._aids, flying=flying)
        if self.flow is not None:
            self.flow.turn(sample.gyro)
        if sample.flow is not None:
            self._look_down(sample.flow)
        if self.flow is not None:
            self.flow.step(now_us, aided=self._aided, flying=flying)
        self._report()

    def receive(self, name: str, reading: Any) -> bool:
        """Process a reading of a client's sensor; return False if none of its kind is fused."""
        if name == "odometry":
            self._see(reading)
        elif name == "distance":
            self._measure(reading, CLIENTS_SENSOR)
        elif name == "flow":
            self._look_down(reading)
        else:
            return False
        self._report()
        return True

    def _report(self) -> None:
        """Update the attributes that the estimator reads."""
        fused, finder = self.vision.fused, self.range
        self.is_idle = finder is None and self.flow is None and not fused
        self.sees_vision = bool(fused)
        self.gives_heading = bool(fused & Control.YAW)
        self.gives_height = bool(fused & Control.VERTICAL)
        if finder is not None:
            self.is_reference, self.ground = finder.is_reference, finder.clearance()

    def _see(self, odometry: Odometry) -> None:
        estimator = self._estimator
        estimator.readings["odometry"] = Received(odometry, estimator.time_us)
        if estimator.aligned:
            # Vision position is not used while GPS is fused, see `external_vision`.
            self.vision.take(
                odometry, estimator.time_us, gps=self._has_gps, flying=estimator.flying
            )

    def _measure(self, reading: DistanceReading, source: int) -> None:
        estimator = self._estimator
        if estimator.aligned:
            self._know_ground().take(reading, estimator.time_us, source)
            estimator.readings["distance"] = Received(reading, estimator.time_us)

    def _look_down(self, reading: FlowReading) -> None:
        estimator = self._estimator
        if not estimator.aligned:
            return
        if self.flow is None:
            self.flow = OpticalFlowFusion(
                estimator.value, estimator.state, self._know_ground(), estimator.fuse
            )
            estimator.horizons.append(self.flow.horizon)
        self.flow.take(reading, estimator.time_us)
        if self.flow.reading is not None:
            estimator.readings["flow"] = Received(self.flow.reading, self.flow.reading_us)

    def _know_ground(self) -> RangeFinder:
        """Return the range finder; the first call adds the terrain state to the filter."""
        # Flights without ranges and flow keep the cheaper filter of 16 states.
        if self.range is None:
            estimator = self._estimator
            estimator.filter = terrain = TerrainFilter(estimator.filter)
            estimator.recovery.use(terrain)
            self.range = RangeFinder(estimator.value, estimator.state, terrain, estimator.time_us)
            self.vision.on_height_moved = self.range.moved
        return self.range

    def height_moved(self, down_m: float) -> None:
        """Shift all heights with the origin of local NED, positive down [m]."""
        if self.range is not None:
            self.range.moved(down_m)
            self._report()

    def correct(self, baro: es.Measurement) -> None:
        """Correct a barometer that is rejected for long if the ground is the height reference."""
        if self.range is not None:
            self.range.correct(baro, self._estimator.time_us)

    def knows_motion(self, now_us: int, longest_us: float, *, flying: bool) -> bool:
        """Return whether horizontal motion was measured within a time [µs]."""
        # Position or velocity: either limits the drift of dead reckoning.
        for m in (self.vision.position, self.vision.velocity):
            if m.fused_us is not None and now_us - m.fused_us <= longest_us:
                return True
        flow = self.flow
        # On the ground, flow that arrives proves a source of position before take-off.
        return flow is not None and (
            flow.told_motion_since(now_us - longest_us) or (not flying and flow.is_coming(now_us))
        )

    def knows_height(self, now_us: int, longest_us: float) -> bool:
        """Return whether height was measured within a time [µs]."""
        seen_us, finder = self.vision.height.fused_us, self.range
        return (seen_us is not None and now_us - seen_us <= longest_us) or (
            finder is not None and finder.told_height_since(now_us - longest_us)
        )

    @property
    def _has_gps(self) -> bool:
        estimator = self._estimator
        return estimator.uses_gps and estimator.fuses_gps(estimator.time_us)

    @property
    def _aided(self) -> bool:
        """True if a sensor other than optical flow measures horizontal motion."""
        return bool(self.vision.fused & (Control.HORIZONTAL | Control.VELOCITY)) or self._has_gps

    def _aids(self) -> Aids:
        """Return the aids besides ranges that measure motion."""
        told = (self._estimator.baro, self._estimator.gps_vertical, self.vision.height)
        return Aids(
            horizontal=self._aided or (self.flow is not None and self.flow.fused),
            vertical_speed=self._has_gps or bool(self.vision.fused & Control.VELOCITY),
            height_us=max(m.fused_us or 0 for m in told),
        )

    def _judge(self, innovation: frames.Vector, variance: frames.Vector) -> float:
        """Check a velocity of external vision against the inertial sensors, at GPS's rate."""
        estimator, now_us = self._estimator, self._estimator.time_us
        # GPS velocities are checked by the estimator; vision replaces them only without GPS.
        if not self._has_gps and now_us - self._judged_us >= _JUDGED_EVERY_US:
            self._judged_us = now_us
            estimator.recovery.take_velocity(innovation, variance, estimator.now)
        return estimator.recovery.consistency.velocity_excess
