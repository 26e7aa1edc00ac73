"""Tells sensors that have gone wrong from noise by how the filter's innovations go on.

Noise changes its sign from sample to sample, however strong it is. Once the accelerometer or the
gyro has an error that the filter does not expect, the innovations of velocity and heading stay on
one side. Then the filter must open up again: what it is sure of, above all the biases, is so no
longer. A receiver whose velocity is noisier than stated shows in the differences of innovations,
which slow errors leave alone.

Sources: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation,
ch. 5.4 (consistency) and 11.2 (adjusting the noise upon a test of the innovations). PX4's EKF2 has
the same answers with other tests: it raises the accelerometer's noise (`BADACC_BIAS_PNOISE`),
resets the variance of the gyro's bias, and gives up a compass (`mag_fault`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from airl_mav.core.constants import GRAVITY_M_S2, US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import kernel

FAR = 3.0
"""An innovation beyond this many standard deviations is one of a run."""

VELOCITY_RUN = 6
"""GPS velocities in a row beyond `FAR` on the same side: 0.6 s at 10 Hz. By chance once in 10^16
samples."""

HEADING_RUN = 25
"""Headings in a row: 0.5 s at 50 Hz."""

LATE_S = 0.5
"""A receiver may be so much later than stated. A velocity that differs by no more than what the
vehicle has changed its own in that time says nothing of the inertial sensors [s]."""

LOOK_BACK = 6
"""Samples over which the greatest acceleration is looked for."""

REFUSED_US = US_PER_S
"""A compass that the gate has refused for so long is given up [µs]."""

NOISY = 4.0
"""A velocity with this many times the variance that it should have is that of a noisy receiver."""

_NOISE_SHARE = 0.1
"""Share of the newest sample in the mean: it looks back 1 s at 10 Hz."""

_OUTLIER = 12.0
"""No sample counts for more: one outlier, which differs twice, is not yet noise."""


class Limits(NamedTuple):
    """Least and greatest standard deviation after a restart."""

    least: float
    greatest: float

    def bound(self, sigma: float) -> float:
        """Return a standard deviation within the limits."""
        return min(max(sigma, self.least), self.greatest)


VELOCITY = Limits(0.3, 10.0)
"""[m/s]"""
ATTITUDE = Limits(0.1, 0.3)
"""[rad]"""
ACCEL_BIAS = Limits(0.5, 5.0)
"""[m/s²]"""
GYRO_BIAS = Limits(0.04, 0.2)
"""2.3 to 11 °/s [rad/s]"""


class Restart(NamedTuple):
    """How far off the filter may be now, as standard deviations."""

    velocity_m_s: float
    attitude_rad: float
    accel_bias_m_s2: float
    gyro_bias_rad_s: float


def restart_for(velocity_m_s: float, seconds: float) -> Restart:
    """Return what explains a velocity that has gone off by so much in so long.

    Either the accelerometer is off by `velocity / time`, or the vehicle is tilted by that much of
    gravity, or the gyro by what tilts it so in that time.
    """
    acceleration = abs(velocity_m_s) / seconds
    tilt = acceleration / GRAVITY_M_S2
    return Restart(
        VELOCITY.bound(abs(velocity_m_s)),
        ATTITUDE.bound(tilt),
        ACCEL_BIAS.bound(acceleration),
        GYRO_BIAS.bound(tilt / seconds),
    )


class Run:
    """How many innovations in a row were far off on the same side."""

    def __init__(self, needed: int) -> None:
        """Begin without any; `needed` of them are no noise."""
        self._needed = needed
        self._side = 0
        self.length = 0
        """How many there are."""
        self._since_us = 0

    def take(self, deviations: float, time_us: int) -> float:
        """Take an innovation in standard deviations.

        Returns:
            How long the run has lasted where it is long enough to be no noise [s], else 0.
        """
        side = (deviations > FAR) - (deviations < -FAR)
        if side == 0 or side != self._side:
            self._side, self.length, self._since_us = side, 0, time_us
        if side == 0:
            return 0.0
        self.length += 1
        return (time_us - self._since_us) / US_PER_S if self.length >= self._needed else 0.0

    def restart(self) -> None:
        """Begin again."""
        self._side = self.length = 0


class Compass:
    """Gives up a compass that the gate has refused for some time.

    Without it the heading's variance grows until the gate lets any heading in. What comes back must
    be as close as was asked for when it was given up.
    """

    def __init__(self) -> None:
        self.given_up = False
        self._failed = False
        self._refused_us: int | None = None
        self._gate_rad = 0.0

    @property
    def is_suspect(self) -> bool:
        """Whether headings are refused, or were lately."""
        return self.given_up or self._failed or self._refused_us is not None

    def admits(self, innovation_rad: float) -> bool:
        """Return whether a heading may be fused, if it passes the gate too."""
        near = not self.given_up or abs(innovation_rad) <= self._gate_rad
        return near and not self._failed

    def fail(self) -> None:
        """Give it up for good: the vehicle has been seen to point elsewhere."""
        self.given_up = self._failed = True

    def tested(self, innovation_rad: float, ratio: float, time_us: int) -> None:
        """Note the test ratio of a heading: beyond 1 it was refused."""
        if ratio <= 1.0:
            self.given_up, self._refused_us = False, None
        elif self._refused_us is None:
            self._refused_us, self._gate_rad = time_us, abs(innovation_rad) / ratio
        elif time_us - self._refused_us >= REFUSED_US:
            self.given_up = True


@kernel
def note_velocity(record: Any, deviations: Vector, acceleration: Vector) -> None:
    """Note a velocity in the record of a flight controller: its noise, the vehicle's acceleration.

    Args:
        record: Updated.
        deviations: Innovation in standard deviations (3,).
        acceleration: As estimated (3,) NED [m/s²].
    """
    square, slot = 0.0, record.fixes % LOOK_BACK
    for i in range(3):
        square += (deviations[i] - record.velocity_before[i]) ** 2
        record.velocity_before[i] = deviations[i]
        record.accelerations[slot, i] = abs(acceleration[i])
    record.fixes += 1
    if not math.isnan(square):
        # Two independent samples differ by twice the variance of one.
        variance = min(square / 6.0, _OUTLIER)
        record.velocity_noise += _NOISE_SHARE * (variance - record.velocity_noise)


@kernel
def _note_velocity(records: Any, deviations: Vector, acceleration: Vector) -> None:
    note_velocity(records[0], deviations, acceleration)


class Consistency:
    """Watches the innovations of velocity and heading."""

    def __init__(self, record: Any = None) -> None:
        """Begin in the record of a flight controller; None = in a new one."""
        if record is None:
            from firmware_sim.engine.record import new_controller

            record = new_controller()
        self._record = record
        self.restarts = 0
        """How often the filter has been restarted."""
        self.restarted_us: int | None = None
        """When that was last."""
        self._runs = [Run(VELOCITY_RUN) for _ in range(3)]
        self._heading = Run(HEADING_RUN)

    @property
    def velocity_deviates(self) -> bool:
        """Whether the newest velocities were far off on one side, or noisy."""
        return any(run.length for run in self._runs) or self.velocity_excess > 1.0

    @property
    def heading_deviates(self) -> bool:
        """Whether the newest headings were far off on one side."""
        return self._heading.length > 0

    @property
    def velocity_excess(self) -> float:
        """By how much the variance of the velocity exceeds what it should be; 1 = it does not."""
        noise: float = self._record["velocity_noise"].item(0)
        return noise if noise > NOISY else 1.0

    def velocity(
        self, innovation: Vector, sigma: Vector, acceleration: Vector, time_us: int
    ) -> Restart | None:
        """Take a GPS velocity.

        Args:
            innovation: Measured less expected (3,) NED [m/s].
            sigma: Standard deviation that the innovation should have (3,) [m/s].
            acceleration: As estimated (3,) NED [m/s²].
            time_us: When.

        Returns:
            What to restart the filter with; None: it may go on.
        """
        deviations = innovation / sigma
        if not np.isfinite(deviations).all():
            return None
        excess, record = self.velocity_excess, self._record
        _note_velocity(record, deviations, acceleration)
        seen = min(record["fixes"].item(0), LOOK_BACK)
        late = LATE_S * np.max(record["accelerations"][0, :seen], axis=0)
        unexplained = np.sign(innovation) * np.maximum(np.abs(innovation) - late, 0.0)
        deviations = unexplained / (sigma * math.sqrt(excess))
        lasted = [
            run.take(z, time_us) for run, z in zip(self._runs, deviations.tolist(), strict=True)
        ]
        if not any(lasted):
            return None
        return self._anew(restart_for(float(np.abs(innovation).max()), max(lasted)))

    def heading(self, deviations: float, time_us: int, *, within: bool) -> Restart | None:
        """Take a heading's innovation in standard deviations, and whether it is within the gate.

        A compass that points elsewhere leaves the gate at once. A gyro's error grows through it:
        only such a run counts.
        """
        if not within and self._heading.length == 0:
            return None
        lasted = self._heading.take(deviations, time_us)
        return self._anew(restart_for(0.0, lasted)) if lasted else None

    def restarted(self, time_us: int) -> None:
        """Note that the filter was restarted with what was returned."""
        self.restarts += 1
        self.restarted_us = time_us

    def _anew(self, restart: Restart) -> Restart:
        for run in (*self._runs, self._heading):
            run.restart()
        self._record["velocity_before"] = np.nan
        return restart
