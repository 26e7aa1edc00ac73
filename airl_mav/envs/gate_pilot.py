"""The expert for gates: it knows where their openings are, and flies from one to the next.

Only the batch twin knows so much: nothing of this flies. It is there to be imitated
(`training.imitation`), and knows of no obstacles beside the gates.

Before a gate it moves to the middle of the opening, sideways and up or down, and goes on through
the wall only as far as it is lined up; until the whole vehicle has passed, it flies straight on.
Behind the last gate it flies to the goal.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.gates import Openings, openings_of
from airl_mav.arena.geometry import Arena
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import ned_to_heading, quats_to_euler
from airl_mav.envs.navigation import Navigation
from airl_mav.policy.action_sets import VELOCITIES, VERTICAL
from airl_mav.policy.actions import fastest_climb

AHEAD_S = 0.4
"""How far ahead of the vehicle its place is taken: about its dead time and half its response."""

GAIN_1_S = 1.0
"""Speed per metre off the middle of an opening, sideways and vertically."""

STANDOFF_M = 2.0
"""Where it waits before a wall until it is lined up [m]."""

BEHIND_M = 0.4
"""So far behind the wall the vehicle turns to the next gate, its own radius added [m]."""

MARGIN_M = 0.35
"""Gap to the frame from which on it flies at full speed [m]."""

NOWHERE = 1e6
"""North of everything [m]: where there is no further gate."""


class GatePilot:
    """Decides for the flights of a batch twin."""

    def __init__(self, navigation: Navigation) -> None:
        """Take the flights.

        Raises:
            FieldError: The action set has no vertical speed, or is a discrete one.
        """
        actions = navigation.spec.action_spec
        if actions.set not in VELOCITIES or actions.set not in VERTICAL:
            accepted = ", ".join(name for name in VELOCITIES if name in VERTICAL)
            raise FieldError("environment.actions", actions.set, f"{accepted} with expert gates")
        self._navigation = navigation
        self._speed, self._climb = actions.max_speed_m_s, fastest_climb(actions.max_speed_m_s)
        self._middle = np.full((navigation.n, 1, 3), NOWHERE)
        self._half = np.ones((navigation.n, 1, 3))
        self._goal = np.zeros((navigation.n, 3))

    def begin(self, slots: Sequence[int]) -> None:
        """Look at the arenas of the episodes that slots begin, or go on with."""
        for i in slots:
            arena = self._navigation.arenas[i]
            assert arena is not None  # noqa: S101 (an episode has begun in it)
            self._put(i, openings_of(arena), arena)

    def _put(self, i: int, openings: Openings, arena: Arena) -> None:
        room = self._middle.shape[1]
        if (more := len(openings) + 1 - room) > 0:
            pad = ((0, 0), (0, more), (0, 0))
            self._middle = np.pad(self._middle, pad, constant_values=NOWHERE)
            self._half = np.pad(self._half, pad, constant_values=1.0)
        self._middle[i], self._half[i] = NOWHERE, 1.0
        self._middle[i, : len(openings)] = openings.center
        self._half[i, : len(openings)] = openings.half_size
        height_m = arena.goal_height_m
        if height_m is None:
            height_m = self._navigation.spec.episode.altitude_m
        self._goal[i] = (*arena.goal, -height_m)

    def decide(self) -> NDArray[np.float32]:
        """Return the actions (n, 3) for the present states."""
        fleet, _, vehicle = self._navigation.whole_truth()
        here = fleet.position + AHEAD_S * fleet.velocity
        _, _, yaw = quats_to_euler(fleet.quaternion)
        each = np.arange(len(here))
        reach = vehicle.radius + BEHIND_M
        passed = self._middle[:, :, 0] + self._half[:, :, 0] + reach < fleet.position[:, 0, None]
        gate = passed.sum(axis=1)
        middle, half = self._middle[each, gate], self._half[each, gate]
        off = middle[:, 1:] - here[:, 1:]
        room = half[:, 1:] - np.array([vehicle.radius, vehicle.half_height]) - MARGIN_M
        # 1: lined up; 0: not within the opening at all.
        share = np.abs(off) / np.maximum(room, 0.1)
        lined_up = np.clip(2.0 - 1.5 * share.max(axis=1), 0.0, 1.0)
        before = middle[:, 0] - half[:, 0] - here[:, 0]
        waiting = np.clip(GAIN_1_S * (before - STANDOFF_M), -1.0, self._speed)
        wanted = np.empty_like(here)
        wanted[:, 0] = lined_up * self._speed + (1.0 - lined_up) * waiting
        wanted[:, 1:] = GAIN_1_S * off
        to_goal = GAIN_1_S * (self._goal - here)
        wanted = np.where((middle[:, 0] >= NOWHERE)[:, None], to_goal, wanted)
        body = ned_to_heading(wanted, yaw)
        level = np.hypot(body[:, 0], body[:, 1])
        body[:, :2] *= np.minimum(1.0, self._speed / np.maximum(level, 1e-9))[:, None]
        body[:, :2] /= self._speed
        body[:, 2] = np.clip(body[:, 2] / self._climb, -1.0, 1.0)
        return body.astype(np.float32)
