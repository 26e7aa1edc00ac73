"""State of a view: the newest message of each kind and a short history."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.frames import goal_distance_m
from airl_mav.view import view_messages

STRIP_S = 20.0
"""Time span of the latency strip [simulated s]."""

TEXTS = 6
"""Number of recent texts shown."""

TRAIL_STEP_M = 0.05
"""Minimum distance between points of the trail [m]."""

OFFBOARD = "offboard"
"""Flight mode that follows setpoints."""

Point = tuple[float, float, float]


@dataclass
class Shown:
    """Data of the scene and the panel."""

    flight: view_messages.Flight | None = None
    phase: str = ""
    texts: deque[view_messages.Said] = field(default_factory=lambda: deque(maxlen=TEXTS))
    episode: view_messages.Episode | None = None
    arena: Arena | None = None
    is_surrounded: bool = True
    """True if the surroundings are known; False while an arena is being generated."""
    episodes: int = 0
    """Number of episodes started so far; a new number requires a new scene."""
    vehicle: view_messages.VehicleState | None = None
    trail: list[Point] = field(default_factory=list)
    """Past positions of the vehicle in this episode, NED [m]."""
    picture: view_messages.Image | None = None
    decided: view_messages.Decided | None = None
    decided_image: view_messages.Image | None = None
    """Policy's input image of that decision."""
    trained: view_messages.Trained | None = None
    """Result of a training's newest decision; None outside training."""
    decisions: int = 0
    """Number of decisions received in this episode."""
    ages: deque[tuple[float, float, float]] = field(default_factory=deque)
    """Time since the episode's start [s], command age and t2 of its decision [ms]."""

    def take(self, message: view_messages.Told, image: view_messages.Image | None) -> None:
        """Update the state with a message and its image."""
        if isinstance(message, view_messages.VehicleState):
            self._move(message)
        elif isinstance(message, view_messages.CameraImage):
            self.picture = image
        elif isinstance(message, view_messages.Decided):
            self.decided, self.decided_image = message, image
            self.decisions += 1
        elif isinstance(message, view_messages.Episode):
            self._begin(message)
        elif isinstance(message, view_messages.PhaseStart):
            self.phase = message.phase
        elif isinstance(message, view_messages.Said):
            self.texts.append(message)
        elif isinstance(message, view_messages.Trained):
            self.trained = message
        else:
            self.flight, self.phase = message, "booting"

    def _begin(self, episode: view_messages.Episode) -> None:
        self.episode = episode
        self.arena = episode.arena
        self.episodes += 1
        self.vehicle = self.picture = self.decided = self.decided_image = None
        self.trail, self.decisions = [], 0
        self.ages.clear()

    def _move(self, vehicle: view_messages.VehicleState) -> None:
        self.vehicle = vehicle
        if not self.trail or math.dist(self.trail[-1], vehicle.position) >= TRAIL_STEP_M:
            self.trail.append(vehicle.position)
        age_ms, t2_ms = self.age_ms, self.t2_ms
        if age_ms is not None and t2_ms is not None:
            self.ages.append((self.seconds, age_ms, t2_ms))
        while self.ages and self.ages[0][0] < self.seconds - STRIP_S:
            self.ages.popleft()

    @property
    def seconds(self) -> float:
        """Time since the episode's start [simulated s]."""
        if self.vehicle is None or self.episode is None:
            return 0.0
        return (self.vehicle.time_us - self.episode.started_us) / US_PER_S

    @property
    def flies_setpoints(self) -> bool:
        """True if the vehicle is armed and follows setpoints."""
        vehicle = self.vehicle
        return vehicle is not None and vehicle.armed and vehicle.mode == OFFBOARD

    @property
    def age_ms(self) -> float | None:
        """Age of the image behind the current command [ms]; None without such a command."""
        if self.decided is None or self.vehicle is None or not self.flies_setpoints:
            return None
        return max(0.0, (self.vehicle.time_us - self.decided.captured_us) / US_PER_MS)

    @property
    def t2_ms(self) -> float | None:
        """Inference time t2 of the newest decision [ms]; None before the first decision."""
        if self.decided is None:
            return None
        return (self.decided.ready_us - self.decided.began_us) / US_PER_MS

    @property
    def command(self) -> NDArray[np.float64] | None:
        """Commanded velocity (3,): forward, right, down [m/s]; None without one."""
        if self.decided is None or self.vehicle is None or not self.flies_setpoints:
            return None
        if self.decided.commands != "velocity":
            return None
        expires_us = self.decided.expires_us
        if expires_us is not None and self.vehicle.time_us >= expires_us:
            return np.zeros(3)
        return np.array(self.decided.setpoint[:3])

    @property
    def to_goal_m(self) -> float | None:
        """Distance to the goal [m]; horizontal for a goal without a height."""
        if self.vehicle is None or self.episode is None:
            return None
        return goal_distance_m(self.episode.goal, self.vehicle.position)
