"""Estimation error: the EKF's error as noise on the batch twin's true state.

Nine errors per vehicle: position NED [m], velocity NED [m/s], attitude as a rotation about north,
east and down [rad]. Each is an independent stationary first-order Gauss-Markov process. This is an
approximation: where the magnetic field is steep, a tilt about north also changes the heading, and
attitude is worst in the first seconds, until an acceleration makes the sensor biases observable.
Every episode draws its random numbers from its seed only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import TICK_S, TICK_US, US_PER_S
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.core.streams import Stream, stream
from airl_mav.envs.draws import BLOCK
from airl_mav.envs.saved_state import Stateful
from airl_mav.policy.observation import Kinematics, Rows
from airl_mav.profiles.vehicle import Estimation

N_ERRORS: Final = 9
POSITION: Final = slice(0, 3)
VELOCITY: Final = slice(3, 6)
ATTITUDE: Final = slice(6, 9)

GROUPS: Final[dict[str, tuple[str, tuple[int, ...]]]] = {
    "position_horizontal_m": ("position_horizontal_time_s", (0, 1)),
    "position_vertical_m": ("position_vertical_time_s", (2,)),
    "velocity_horizontal_m_s": ("velocity_horizontal_time_s", (3, 4)),
    "velocity_vertical_m_s": ("velocity_vertical_time_s", (5,)),
    "tilt_rad": ("tilt_time_s", (6, 7)),
    "heading_rad": ("heading_time_s", (8,)),
}
"""`Estimation` field of the standard deviation -> field of the time constant, error indices."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EstimationError:
    """Standard deviation and correlation time of each of the nine errors."""

    sd: Array  # (9,) [m], [m/s], [rad]
    time_s: Array  # (9,)

    @classmethod
    def from_profile(cls, table: Estimation, noise: float = 1.0) -> EstimationError:
        """Return the model of a vehicle profile's `estimation` table, its errors times `noise`.

        The estimator's gains are independent of the actual sensor noise, so to first order its
        errors are proportional to the noise.
        """
        sd, time_s = np.empty(N_ERRORS), np.empty(N_ERRORS)
        for name, (time_name, errors) in GROUPS.items():
            sd[list(errors)] = noise * getattr(table, name)
            time_s[list(errors)] = getattr(table, time_name)
        return cls(sd, time_s)

    def step(self, dt: float | Array) -> tuple[Array, Array]:
        """Return the change of errors in dt [s]; exact for steps of any length.

        Returns:
            (..., 9) the remaining share, and the standard deviation of the added noise.
        """
        kept = np.exp(-np.asarray(dt)[..., None] / self.time_s)
        return kept, self.sd * np.sqrt(1.0 - kept * kept)


def perturbed(
    position: Array, velocity: Array, quaternion: Array, errors: Array
) -> tuple[Array, Array, Array]:
    """Return position, velocity and attitude as reported by the flight controller.

    Args:
        position: (..., 3) true, NED [m].
        velocity: (..., 3) true, NED [m/s].
        quaternion: (..., 4) true, body -> NED.
        errors: (..., 9).
    """
    turn = errors[..., ATTITUDE]
    angle = np.linalg.norm(turn, axis=-1)
    # np.sinc(x) is sin(pi x) / (pi x), finite at angle 0.
    share = 0.5 * np.sinc(angle / (2.0 * np.pi))
    estimated = np.empty(quaternion.shape)
    _turn(
        np.cos(0.5 * angle).ravel(),
        share.ravel(),
        turn.reshape(-1, 3),
        quaternion.reshape(-1, 4),
        estimated.reshape(-1, 4),
    )
    return position + errors[..., POSITION], velocity + errors[..., VELOCITY], estimated


@kernel
def _turn(cos: Array, share: Array, turn: Array, quaternion: Array, out: Array) -> None:
    """Write the products (n, 4) of rotations cos, share turn (n, 3) and quaternions (n, 4)."""
    # Hamilton product of the error's rotation and the attitude.
    for i in range(len(out)):
        w = cos[i]
        x, y, z = share[i] * turn[i, 0], share[i] * turn[i, 1], share[i] * turn[i, 2]
        s, a, b, c = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
        out[i, 0] = w * s - (x * a + y * b + z * c)
        out[i, 1] = w * a + s * x + (y * c - z * b)
        out[i, 2] = w * b + s * y + (z * a - x * c)
        out[i, 3] = w * c + s * z + (x * b - y * a)


class Drift(NamedTuple):
    """Error dynamics over a decision, as an argument for kernels."""

    kept: Array
    """(ticks, 9) remaining share of an error after a number of ticks."""
    added: Array
    """(ticks, 9) standard deviation of the added noise."""
    normals: Array
    """(n, BLOCK, 9) standard normal numbers of the present decisions."""
    sd: Array
    """(9,) field of `EstimationError`, as is `time_s`."""
    time_s: Array


TABLE_S = 60.0
"""Maximum duration of decisions with a row in `Drift` [s]."""


@borrowing_kernel
def step_error(drift: Drift, errors: Array, i: int, decision: int, ticks: int) -> None:
    """Step the errors (n, 9) of vehicle i after its n-th decision, which took `ticks`."""
    row = decision % BLOCK
    for k in range(N_ERRORS):
        # Longer decisions have no row in the table.
        if ticks < len(drift.kept):
            kept, added = drift.kept[ticks, k], drift.added[ticks, k]
        else:
            kept = math.exp(-(ticks * TICK_S) / drift.time_s[k])
            added = drift.sd[k] * math.sqrt(1.0 - kept * kept)
        errors[i, k] = kept * errors[i, k] + added * drift.normals[i, row, k]


class TelemetryErrors(Stateful):
    """Telemetry of n episodes: the true state plus errors that change once per decision."""

    def __init__(self, n: int, table: Estimation | None, noise: float = 1.0) -> None:
        """Create n slots with the errors of a vehicle profile times `noise`; None = no errors."""
        self._model = None if table is None else EstimationError.from_profile(table, noise)
        self.errors = np.zeros((n, N_ERRORS))
        """(n, 9) present errors."""
        self._rngs: list[np.random.Generator | None] = [None] * n
        self._normals = np.zeros((n, BLOCK, N_ERRORS))
        """Standard normal numbers, `N_ERRORS` per decision, the first for the episode's start."""

    def drift(self) -> Drift | None:
        """Return the error dynamics for kernels; None without errors.

        The table uses numpy's exponential, which differs from a compiled one by a bit.
        """
        if self._model is None:
            return None
        ticks = np.arange(round(TABLE_S / TICK_S))
        changes = self._model.step(ticks * TICK_US / US_PER_S)
        return Drift(*changes, self._normals, self._model.sd, self._model.time_s)

    def begin(self, i: int, seed: int) -> None:
        """Start the episode of slot i."""
        if self._model is not None:
            rng = stream(seed, Stream.ESTIMATION)
            self._rngs[i], self._normals[i] = rng, rng.standard_normal((BLOCK, N_ERRORS))
            # The first draw starts the process in its stationary distribution.
            self.errors[i] = self._model.sd * self._normals[i, 0]

    def draw(self, decisions: NDArray[np.int64]) -> None:
        """Draw the numbers of slots whose n-th decision (n,) starts a block."""
        if self._model is None:
            return
        for i in np.flatnonzero(decisions % BLOCK == 0):
            rng = self._rngs[i]
            if rng is not None:
                rng.standard_normal(out=self._normals[i])

    def report(self, truth: Kinematics, rows: Rows) -> Kinematics:
        """Return the states of `rows` as reported by telemetry; body rates have no error."""
        if self._model is None:
            return truth
        errors = self.errors[rows]
        told = perturbed(truth.position, truth.velocity, truth.quaternion, errors)
        return Kinematics(*told, truth.rates)

    def _held(self) -> Mapping[str, Any]:
        return {
            "now": {"errors": self.errors},
            "normals": {"block": self._normals, "generators": self._rngs},
        }
