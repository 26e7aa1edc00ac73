"""What the companions of n flights know: their own decisions, and what is seen when they act.

As `companion.pilot` keeps it for one: the account of the decisions, which a policy may be told, and
where latency is compensated the newest images and states, carried forward.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.policy.observation import Earlier, InFlight, Kinematics, Rows, View
from airl_mav.prediction.compensator import Compensator
from airl_mav.prediction.memory import DecisionMemory

Times = NDArray[np.int64]
"""(n,) [µs]."""


class Companions:
    """The companions of n vehicles."""

    def __init__(
        self,
        n: int,
        image: Intrinsics,
        *,
        compensator: Compensator | None,
        told: bool,
        earlier: int = 0,
        further: Mapping[str, tuple[Intrinsics, int]] | None = None,
    ) -> None:
        """Prepare n companions.

        Args:
            n: Number of companions.
            image: Of their cameras.
            compensator: Carries forward what is seen; None: nothing does.
            told: Whether the policy is told of its decisions.
            earlier: How many images of the decisions before a policy sees.
            further: Further cameras by name, and how many of their earlier images it sees.
        """
        self._n = n
        self._compensator = compensator
        self._memory: DecisionMemory | None = None
        if compensator is not None:
            self._memory = compensator.memory
            self._image = np.zeros((n, *image.shape), image.dtype)
            self._state = Kinematics(np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 4)))
        elif told:
            self._memory = DecisionMemory(n)
        self._earlier = np.zeros((earlier, n, *image.shape), image.dtype)
        """What the decisions before saw, the newest first; 0 = no return, black, or none yet."""
        self._states = Kinematics(*(np.zeros((earlier, n, size)) for size in (3, 3, 4)))
        """In what states."""
        self._further = {
            name: np.zeros((count, n, *lens.shape), lens.dtype)
            for name, (lens, count) in (further or {}).items()
        }
        """What further cameras showed them, by name."""
        self._age_us = np.zeros(n, np.int64)
        """Of the frames, when their decisions begin."""

    def begin(self, i: int) -> None:
        """Begin the flight of companion i, in a hover; its first frame is new."""
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
        """Whether they keep account of their decisions."""
        return self._memory is not None

    @property
    def remember(self) -> bool:
        """Whether they keep what they saw: their policies see it again."""
        return len(self._earlier) > 0 or any(map(len, self._further.values()))

    def deciding(
        self, image: NDArray[Any], state: Kinematics, further: Mapping[str, NDArray[Any]]
    ) -> None:
        """Keep what all decide on, of those that `remember`.

        Args:
            image: (n, ...) newest images of the main cameras.
            state: Telemetry.
            further: (n, ...) those of further cameras, by name.
        """
        if self._compensator is not None:
            image, state = self._image, self._state
        states = zip(self._states.known().values(), state.known().values(), strict=True)
        others = ((kept, further[name]) for name, kept in self._further.items())
        for kept, new in ((self._earlier, image), *states, *others):
            if len(kept):
                kept[1:] = kept[:-1]
                kept[0] = new

    def aged(self, age_us: Times) -> None:
        """Take how old the frames (n,) are of which the next decisions are made."""
        self._age_us[:] = age_us

    def decided(
        self, setpoints: NDArray[np.float64], t2_us: Times, sent_us: Times, stop_us: Times | None
    ) -> None:
        """Take the setpoints that all have sent.

        Args:
            setpoints: (n, 4) as `Fleet.setpoint`.
            t2_us: What the decisions took.
            sent_us: When they were sent.
            stop_us: When each is replaced by a stop if no other has come; None: never.
        """
        everyone = np.arange(self._n)
        if self._compensator is not None:
            self._compensator.decided(everyone, setpoints, t2_us, sent_us, stop_us)
        elif self._memory is not None:
            self._memory.decided(everyone, setpoints, t2_us)

    @property
    def foresee(self) -> bool:
        """Whether they look ahead: latency is compensated."""
        return self._compensator is not None

    def look_ahead(
        self,
        who: NDArray[np.bool_],
        image: NDArray[Any],
        now_us: Times,
        state: Kinematics,
    ) -> None:
        """Carry what is seen forward to when the next decisions act, of those that `foresee`.

        Args:
            who: (n,) the companions that decide next.
            image: (n, h, w) newest depth images [mm], 0 = no return.
            now_us: When their decisions begin.
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
        """Return what the decisions of those that `foresee` will act on: images and states."""
        return self._image[rows], self._state.rows(rows)

    def told(self, rows: Rows) -> InFlight | None:
        """Return what policies may be told of the decisions; None: nobody keeps account."""
        return None if self._memory is None else self._memory.in_flight(self._age_us).rows(rows)

    def earlier(self, rows: Rows) -> Earlier:
        """Return what the decisions before saw, and in what states, the newest first."""
        kept = (self._earlier, *self._states.known().values())
        return [
            (each[0][rows], Kinematics(*each[1:]).rows(rows)) for each in zip(*kept, strict=True)
        ]

    def views(
        self, images: Mapping[str, NDArray[Any]], lenses: Mapping[str, Intrinsics], rows: Rows
    ) -> dict[str, View]:
        """Return what further cameras show, of their newest images (n, ...) by name."""
        return {
            name: View(image[rows], lenses[name], tuple(each[rows] for each in self._further[name]))
            for name, image in images.items()
        }

    def held(self) -> Mapping[str, Any]:
        """Return by name all arrays that change, for checkpoints."""
        held: dict[str, Any] = {}
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
