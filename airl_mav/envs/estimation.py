"""Estimation error: the EKF's error as noise on the batch twin's true state.

Nine errors a vehicle: position NED [m], velocity NED [m/s], attitude as a turn about north, east
and down [rad]. Each is a stationary first-order Gauss-Markov process of its own. In truth they are
not quite that: where the magnetic field dips steeply, a tilt about north turns the heading with it;
and attitude is worst in the first seconds, until an acceleration has shown the sensors' biases.

Every episode draws its random numbers from its own seed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.kernels import kernel
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
"""`Estimation` field of the standard deviation -> field of the time, and the errors they are of."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EstimationError:
    """Standard deviation and correlation time of each of the nine errors."""

    sd: Array  # (9,) [m], [m/s], [rad]
    time_s: Array  # (9,)

    @classmethod
    def from_profile(cls, table: Estimation, noise: float = 1.0) -> EstimationError:
        """Return the model of a vehicle profile's `estimation` table, its errors times `noise`.

        The estimator's gains do not depend on the noise that its sensors have, as nobody tells it:
        to first order its errors are in proportion to theirs.
        """
        sd, time_s = np.empty(N_ERRORS), np.empty(N_ERRORS)
        for name, (time_name, errors) in GROUPS.items():
            sd[list(errors)] = noise * getattr(table, name)
            time_s[list(errors)] = getattr(table, time_name)
        return cls(sd, time_s)


def step_errors(model: EstimationError, errors: Array, normals: Array, dt: float | Array) -> Array:
    """Return the errors after dt: exact for any dt, so that steps may be of any length.

    Args:
        model: Standard deviations and correlation times.
        errors: (..., 9) before.
        normals: (..., 9) standard normal numbers.
        dt: Seconds, for all or (...) for each vehicle; 0 changes nothing.
    """
    kept = np.exp(-np.asarray(dt)[..., None] / model.time_s)
    return kept * errors + model.sd * np.sqrt(1.0 - kept * kept) * normals


def perturbed(
    position: Array, velocity: Array, quaternion: Array, errors: Array
) -> tuple[Array, Array, Array]:
    """Return position, velocity and attitude as the flight controller reports them.

    Args:
        position: (..., 3) true, NED [m].
        velocity: (..., 3) true, NED [m/s].
        quaternion: (..., 4) true, body -> NED.
        errors: (..., 9).
    """
    turn = errors[..., ATTITUDE]
    angle = np.linalg.norm(turn, axis=-1)
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
    """Write the Hamilton products (n, 4) of turns cos, share turn (n, 3) and quaternions (n, 4)."""
    for i in range(len(out)):
        w = cos[i]
        x, y, z = share[i] * turn[i, 0], share[i] * turn[i, 1], share[i] * turn[i, 2]
        s, a, b, c = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
        out[i, 0] = w * s - (x * a + y * b + z * c)
        out[i, 1] = w * a + s * x + (y * c - z * b)
        out[i, 2] = w * b + s * y + (z * a - x * c)
        out[i, 3] = w * c + s * z + (x * b - y * a)


class Telemetry(Stateful):
    """Telemetry of n episodes: the truth with errors that change once a decision."""

    def __init__(self, n: int, table: Estimation | None, noise: float = 1.0) -> None:
        """Make n slots with the errors of a vehicle profile times `noise`; None: no errors."""
        self._model = None if table is None else EstimationError.from_profile(table, noise)
        self._errors = np.zeros((n, N_ERRORS))
        self._rngs: list[np.random.Generator | None] = [None] * n
        self._normals = np.zeros((n, BLOCK, N_ERRORS))
        """Standard normal numbers, `N_ERRORS` per decision, the first for the episode's start."""

    def begin(self, i: int, seed: int) -> None:
        """Start the episode of slot i."""
        if self._model is not None:
            rng = stream(seed, Stream.ESTIMATION)
            self._rngs[i], self._normals[i] = rng, rng.standard_normal((BLOCK, N_ERRORS))
            self._errors[i] = self._model.sd * self._normals[i, 0]

    def step(self, decisions: NDArray[np.int64], flown_s: NDArray[np.float64]) -> None:
        """Step the errors after each slot's n-th decision (n,), which took `flown_s` (n,) [s]."""
        if self._model is None:
            return
        for i in np.flatnonzero(decisions % BLOCK == 0):
            rng = self._rngs[i]
            if rng is not None:
                rng.standard_normal(out=self._normals[i])
        # By whole rows: several times faster than by two indices.
        rows = np.arange(len(decisions)) * BLOCK + decisions % BLOCK
        normals = self._normals.reshape(-1, N_ERRORS).take(rows, axis=0)
        self._errors = step_errors(self._model, self._errors, normals, flown_s)

    def report(self, truth: Kinematics, rows: Rows) -> Kinematics:
        """Return the states of `rows` as telemetry reports them; body rates have no error."""
        if self._model is None:
            return truth
        errors = self._errors[rows]
        told = perturbed(truth.position, truth.velocity, truth.quaternion, errors)
        return Kinematics(*told, truth.rates)

    def position(self, truth: Array) -> Array:
        """Return the positions (n, 3) of all n as telemetry reports them; see `report`."""
        return truth if self._model is None else truth + self._errors[:, POSITION]

    def _held(self) -> Mapping[str, Any]:
        return {
            "now": {"errors": self._errors},
            "normals": {"block": self._normals, "generators": self._rngs},
        }
