"""Latency and compensation of a flight, changed by hand while it flies."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import US_PER_MS
from airl_mav.latency.samplers import LatencySampler
from airl_mav.policy.observation import Kinematics
from airl_mav.prediction.compensator import Compensator
from airl_mav.scenario.resolved import ResolvedScenario
from airl_mav.view.messages import Steering


class Hand:
    """What the watchers have set, as one companion flies by it."""

    def __init__(self, newest: Callable[[], Steering], *, compensate: bool) -> None:
        """Take what gives the newest that they ask for, and whether the scenario compensates."""
        self.touched = False
        """Whether a decision of this flight was made otherwise than the scenario says."""
        self._newest = newest
        self._known = Steering()
        self._as_asked = compensate

    def t2_us(self) -> int | None:
        """Return the latency that is set for the coming decision [µs]; None: the scenario's.

        What the watchers want is asked here, once a decision and before its time begins.
        """
        self._known = self._newest()
        t2_ms = self._known.t2_ms
        if t2_ms is None:
            return None
        self.touched = True
        return round(t2_ms * US_PER_MS)

    def compensates(self) -> bool:
        """Return whether this decision is compensated."""
        wanted = self._known.compensate
        if wanted is None or wanted == self._as_asked:
            return self._as_asked
        self.touched = True
        return wanted


class HandLatency:
    """A latency that may be set by hand. Implements `latency.samplers.LatencySampler`."""

    def __init__(self, hand: Hand, sampler: LatencySampler | None) -> None:
        """Take what is set, and where the scenario draws t2 from; None: nothing is injected."""
        self._hand, self._sampler = hand, sampler

    def sample_us(self) -> int:
        """Return the next latency [µs]."""
        # Drawn in any case: the scenario's own go on where they would be.
        drawn_us = 0 if self._sampler is None else self._sampler.sample_us()
        set_us = self._hand.t2_us()
        return drawn_us if set_us is None else set_us


class HandCompensator(Compensator):
    """A compensator that may be switched on and off in flight."""

    def __init__(self, hand: Hand, scenario: ResolvedScenario) -> None:
        """Make the one of a scenario; its vehicle's response is known."""
        super().__init__(1, scenario.vehicle, Intrinsics.of(scenario.vehicle.camera))
        self._hand = hand

    def foresee(
        self,
        who: NDArray[np.intp],
        depth_mm: NDArray[np.uint16],
        age_us: NDArray[np.int64],
        now_us: NDArray[np.int64],
        state: Kinematics,
    ) -> tuple[NDArray[np.uint16], Kinematics]:
        """Return what is seen when the decision will act, or as it is while switched off."""
        if self._hand.compensates():
            return super().foresee(who, depth_mm, age_us, now_us, state)
        for i in who.tolist():
            self.forget(i)
        return depth_mm, state
