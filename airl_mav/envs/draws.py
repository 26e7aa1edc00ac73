"""Random draws of an episode from its seed only: latency, wind and telemetry errors.

An episode is therefore independent of the number of parallel flights. Draws for decisions are made
ahead, a block of decisions at a time.

Telemetry errors represent the EKF's error as noise on the simulator's true state. Nine errors per
vehicle: position NED [m], velocity NED [m/s], attitude as a rotation about north, east and down
[rad]. Each is an independent stationary first-order Gauss-Markov process. This is an approximation:
where the magnetic field is steep, a tilt about north also changes the heading, and attitude is
worst in the first seconds, until an acceleration makes the sensor biases observable.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import TICK_S, TICK_US, US_PER_S
from airl_mav.core.frames import Vector
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.core.streams import Stream, sensors_and_gusts, stream
from airl_mav.envs.faults import gusts, gym_faults, lasting
from airl_mav.envs.fleet import Fleet, FlightStatus
from airl_mav.envs.saved_state import State, Stateful
from airl_mav.faults import Fault
from airl_mav.latency.injection import Injection, LatencySampler, latency_generator
from airl_mav.policy.observation import Kinematics, Rows
from airl_mav.profiles.vehicle import Estimation, WindSettings
from airl_mav.vehicle.atmosphere import BLOCK as WIND_BLOCK
from airl_mav.vehicle.atmosphere import Wind, wind_of_episode

BLOCK = 32
"""Number of decisions drawn at a time."""

NOT_BEGUN = -1
"""Seed of a slot without an episode."""


class DrawnAhead(Stateful):
    """Draws of n episodes, made ahead a block at a time."""

    def __init__(self, n: int) -> None:
        """Prepare n slots."""
        self._seeds = np.full(n, NOT_BEGUN, np.int64)
        self._blocks = np.zeros(n, np.int64)
        """Number of blocks drawn in the slot's episode."""

    @abstractmethod
    def begin(self, i: int, seed: int) -> Any:
        """Start the episode of slot i."""

    @abstractmethod
    def _draw_block(self, i: int) -> None:
        """Draw the next block of slot i, and count it."""

    def _held(self) -> Mapping[str, Any]:
        return {"seeds": self._seeds, "blocks": self._blocks}

    def set_state(self, state: State) -> None:
        """Restore a saved state by repeating its draws. Raises UsageError for a mismatch."""
        super().set_state(state)
        for i in np.flatnonzero(self._seeds != NOT_BEGUN).tolist():
            blocks = int(self._blocks[i])
            self.begin(i, int(self._seeds[i]))
            while self._blocks[i] < blocks:
                self._draw_block(i)


def source_of(injections: Sequence[Injection], seed: int) -> Injection:
    """Return the source of t2 for an episode's seed, drawn from one or more."""
    if len(injections) == 1:
        return injections[0]
    return injections[int(stream(seed, Stream.SOURCE).integers(len(injections)))]


class DelayDraws(DrawnAhead):
    """t2 of every decision of n episodes [µs]."""

    def __init__(
        self, n: int, injections: Sequence[Injection], native_us: int, *, draw: int = 0
    ) -> None:
        """Prepare n slots.

        Args:
            n: Number of slots.
            injections: One or more; each episode draws one of them.
            native_us: t2 without injection [µs].
            draw: See `injection.latency_generator`.
        """
        super().__init__(n)
        self._injections = tuple(injections)
        self._native_us = native_us
        self._draw = draw
        self._samplers: list[LatencySampler | None] = [None] * n
        self.block = np.full((n, BLOCK), native_us, np.int64)
        """(n, BLOCK) t2 of the present decisions [µs]; decision k is in column k % BLOCK."""

    def begin(self, i: int, seed: int) -> None:
        """Start the episode of slot i. The companion draws the same latencies from this seed."""
        injection = source_of(self._injections, seed)
        self._seeds[i], self._blocks[i] = seed, 0
        # Creating a generator takes time, even without draws.
        self._samplers[i] = (
            None
            if injection.latency is None
            else injection.sampler(latency_generator(seed, self._draw))
        )
        self.block[i] = self._native_us

    def draw(self, decision: NDArray[np.int64]) -> None:
        """Draw the next block of slots whose `decision` (n,), counted from 0, starts a block."""
        # All draws of a block come from the episode's generator, in order.
        for i in np.flatnonzero(decision % BLOCK == 0):
            self._draw_block(int(i))

    def _draw_block(self, i: int) -> None:
        sampler = self._samplers[i]
        if sampler is not None:
            self.block[i] = [sampler.sample_us() for _ in range(BLOCK)]
            self._blocks[i] += 1


class Winds(DrawnAhead):
    """Wind of n episodes; the same gust history per seed as in the plant."""

    def __init__(self, n: int, settings: WindSettings, faults: Sequence[Fault] = ()) -> None:
        """Prepare n slots; `faults` of the wind act in all of them."""
        super().__init__(n)
        self._faults = gym_faults(faults, "wind")
        # Every field except the gust's time constant is 0.
        still = not (set(settings.model_dump(exclude={"gust_time_s"}).values()) - {0.0})
        self.calm = still and not self._faults
        """True if no wind blows in any episode."""
        self._settings = settings
        self.gusty = settings.gust_m_s > 0.0 or bool(self._faults)
        self._winds: list[Wind | None] = [None] * n
        # No gusts: one row holds the steady wind for the whole flight.
        self.air = np.zeros((n, WIND_BLOCK if self.gusty else 0 if self.calm else 1, 3))
        """(n, k, 3) present blocks, as an argument of `fleet_step.advance`."""

    def begin(self, i: int, seed: int) -> Vector:
        """Start the episode of slot i; return its steady wind (3,) NED [m/s]."""
        if self.calm:
            return np.zeros(3)
        rng = sensors_and_gusts(np.random.default_rng(seed))[1]
        wind = Wind(wind_of_episode(self._settings, seed), rng)
        self._winds[i], self._seeds[i], self._blocks[i] = wind, seed, 0
        self._draw_block(i)
        # Faults since before the flight have already tilted the vehicle at its start.
        return wind.steady + lasting(self._faults) if self._faults else wind.steady

    def ends_us(self) -> NDArray[np.int64] | None:
        """Return the end times of the present blocks (n,); None for steady wind."""
        return self._blocks * WIND_BLOCK * TICK_US if self.gusty else None

    def blow(self, fleet: Fleet) -> None:
        """Draw the next block of flights at the end of their block."""
        ends_us = self.ends_us()
        if ends_us is not None:
            due = (fleet.verdict == FlightStatus.FLYING) & (fleet.time_us >= ends_us)
            for i in np.flatnonzero(due).tolist():
                self._draw_block(i)

    def _draw_block(self, i: int) -> None:
        wind = self._winds[i]
        if wind is not None:
            self.air[i] = wind.ahead()
            # The block number counts from the start of the episode, as the faults' times do.
            if self._faults:
                self.air[i] += gusts(self._faults, int(self._blocks[i]) * WIND_BLOCK, WIND_BLOCK)
            self._blocks[i] += 1


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
