"""What telemetry tells of n vehicles: the truth with the estimator's error."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from airl_mav.envs.draws import NormalDraws
from airl_mav.envs.estimation import (
    N_ERRORS,
    EstimationError,
    first_errors,
    perturbed,
    step_errors,
)
from airl_mav.envs.state import State, join, part_of, restore
from airl_mav.policy.observation import Kinematics
from airl_mav.profiles.vehicle import Estimation


class Telemetry:
    """The errors of n episodes, each drawn from its own seed; they change once a decision."""

    def __init__(self, n: int, table: Estimation | None) -> None:
        """Take what the errors are like; None: there are none."""
        self._model = None if table is None else EstimationError.from_profile(table)
        self._errors = np.zeros((n, N_ERRORS))
        self._normals = NormalDraws(n)

    def begin(self, i: int, seed: int) -> None:
        """Start the episode of slot i."""
        if self._model is not None:
            self._errors[i] = first_errors(self._model, self._normals.begin(i, seed))

    def step(self, decisions: NDArray[np.int64], flown_s: NDArray[np.float64]) -> None:
        """Go on after each slot's 1st, 2nd, ... decision (n,), which took `flown_s` (n,) [s]."""
        if self._model is not None:
            normals = self._normals.take(decisions)
            self._errors = step_errors(self._model, self._errors, normals, flown_s)

    def tell(self, truth: Kinematics) -> Kinematics:
        """Return the state of all n as telemetry reports it."""
        if self._model is None:
            return truth
        return Kinematics(
            *perturbed(truth.position, truth.velocity, truth.quaternion, self._errors)
        )

    def get_state(self) -> State:
        """Return the present errors and what is drawn of the next ones."""
        errors = {"errors": self._errors.copy()}
        return join({"now": errors, "normals": self._normals.get_state()})

    def set_state(self, state: State) -> None:
        """Go on from a saved state. Raises UsageError when it does not fit."""
        restore(self._errors, part_of(state, "now"), "errors")
        self._normals.set_state(part_of(state, "normals"))
