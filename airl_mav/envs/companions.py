"""Companion state of n flights: past decisions, and predicted observations.

The batch counterpart of `companion.pilot`: a record of decisions as optional policy input, and with
latency compensation the newest images and states, predicted forward.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.policy.observation import CameraView, Earlier, InFlight, Kinematics, Rows
from airl_mav.prediction import Compensator, DecisionMemory

Times = NDArray[np.int64]
"""(n,) [µs]."""


class Companions:
    """Companions of n vehicles."""

    def __init__(
        self,
        n: int,
        image: Intrinsics,
        *,
        compensator: Compensator | None,
        in_flight: bool,
        earlier: int = 0,
        further: Mapping[str, tuple[Intrinsics, int]] | None = None,
    ) -> None:
        """Prepare n companions.

        Args:
            n: Number of companions.
            image: Intrinsics of the main cameras.
            compensator: Predicts observations; None = no compensation.
            in_flight: True if past decisions are a policy input.
            earlier: Number of images of previous decisions as policy input.
            further: Additional cameras by name, with the number of their earlier images.
        """
        self._n = n
        self._compensator = compensator
        self._memory: DecisionMemory | None = None
        if compensator is not None:
            self._memory = compensator.memory
            self._image = np.zeros((n, *image.shape), image.dtype)
            self._state = Kinematics(np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 4)))
        elif in_flight:
            self._memory = DecisionMemory(n)
        self._earlier = np.zeros((earlier, n, *image.shape), image.dtype)
        """Images of previous decisions, newest first; 0 = no return, black, or missing."""
        position, velocity, quaternion = (np.zeros((earlier, n, size)) for size in (3, 3, 4))
        self._states = Kinematics(position, velocity, quaternion)
        """States of previous decisions."""
        self._further = {
            name: np.zeros((count, n, *lens.shape), lens.dtype)
            for name, (lens, count) in (further or {}).items()
        }
        """Earlier images of additional cameras, by name."""
        self._age_us = np.zeros(n, np.int64)
        """Age of the frames at the start of their decisions."""

    def begin(self, i: int) -> None:
        """Start the flight of companion i from a hover; its first frame has age 0."""
        if self._compensator is not None:
            self._compensator.begin(i)
        elif self._memory is not None:
            self._memory.begin(i)
        self._age_us[i] = 0
        self._earlier[:, i] = 0
        for kept in self._further.values():
            kept[:, i] = 0

    @property
    def account(self) -> bool:
        """True if the companions record their decisions."""
        return self._memory is not None

    @property
    def remember(self) -> bool:
        """True if the companions keep earlier observations for the policy."""
        return len(self._earlier) > 0 or any(map(len, self._further.values()))

    def deciding(
        self, image: NDArray[Any], state: Kinematics, further: Mapping[str, NDArray[Any]]
    ) -> None:
        """Store the observations of all decisions; requires `remember`.

        Args:
            image: (n, ...) newest images of the main cameras.
            state: Telemetry.
            further: (n, ...) newest images of additional cameras, by name.
        """
        # With compensation the policy has decided on predicted observations.
        if self._compensator is not None:
            image, state = self._image, self._state
        states = zip(self._states.known().values(), state.known().values(), strict=True)
        others = ((kept, further[name]) for name, kept in self._further.items())
        for kept, new in ((self._earlier, image), *states, *others):
            if len(kept):
                # Newest first: shift by one decision.
                kept[1:] = kept[:-1]
                kept[0] = new

    def aged(self, age_us: Times) -> None:
        """Set the age (n,) of the next decisions' frames."""
        self._age_us[:] = age_us

    def decided(
        self, setpoints: NDArray[np.float64], t2_us: Times, sent_us: Times, stop_us: Times | None
    ) -> None:
        """Record the setpoints of all vehicles.

        Args:
            setpoints: (n, 4) as `Fleet.setpoint`.
            t2_us: Inference times of the decisions.
            sent_us: Times of sending.
            stop_us: Times at which a stop replaces each setpoint without a new one; None = never.
        """
        # Ended flights are recorded too; `begin` clears them.
        everyone = np.arange(self._n)
        if self._compensator is not None:
            self._compensator.decided(everyone, setpoints, t2_us, sent_us, stop_us)
        elif self._memory is not None:
            self._memory.decided(everyone, setpoints, t2_us)

    @property
    def foresee(self) -> bool:
        """True if observations are predicted (latency compensation)."""
        return self._compensator is not None

    def look_ahead(
        self,
        who: NDArray[np.bool_],
        image: NDArray[Any],
        now_us: Times,
        state: Kinematics,
    ) -> None:
        """Predict observations for the time at which the next decisions act; requires `foresee`.

        Args:
            who: (n,) companions that decide next.
            image: (n, h, w) newest depth images [mm], 0 = no return.
            now_us: Start times of their decisions.
            state: Telemetry of all n.
        """
        if self._compensator is None:
            return
        foreseen, then = self._compensator.foresee(
            np.flatnonzero(who), image, self._age_us, now_us, state
        )
        self._image[who] = foreseen[who]
        for kept, found in zip(self._state.known().values(), then.known().values(), strict=True):
            kept[who] = found[who]

    def foreseen(self, rows: Rows) -> tuple[NDArray[Any], Kinematics]:
        """Return predicted images and states for the next decisions; requires `foresee`."""
        return self._image[rows], self._state.rows(rows)

    def in_flight(self, rows: Rows) -> InFlight | None:
        """Return past decisions as policy input; None without a record."""
        return None if self._memory is None else self._memory.in_flight(self._age_us).rows(rows)

    def earlier(self, rows: Rows) -> Earlier:
        """Return images and states of previous decisions, newest first."""
        kept = (self._earlier, *self._states.known().values())
        return [
            (each[0][rows], Kinematics(*each[1:]).rows(rows)) for each in zip(*kept, strict=True)
        ]

    def views(
        self, images: Mapping[str, NDArray[Any]], lenses: Mapping[str, Intrinsics], rows: Rows
    ) -> dict[str, CameraView]:
        """Return the views of additional cameras from their newest images (n, ...) by name."""
        return {
            name: CameraView(
                image[rows], lenses[name], tuple(each[rows] for each in self._further[name])
            )
            for name, image in images.items()
        }

    def held(self) -> Mapping[str, Any]:
        """Return all variable arrays by name, for checkpoints."""
        held: dict[str, Any] = {}
        # Unused parts are not saved.
        if self.remember:
            held["earlier"] = {"depth_mm": self._earlier, **self._states.known()}
            kept = {name: each for name, each in self._further.items() if len(each)}
            if kept:
                held["earlier_further"] = kept
        if self._compensator is not None:
            foreseen = {"depth_mm": self._image, **self._state.known()}
            held["compensator"] = {**self._compensator.held(), "foreseen": foreseen}
        if self._memory is not None:
            held["decisions"] = {**self._memory.held(), "age_us": self._age_us}
        return held
