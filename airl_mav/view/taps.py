"""Where a flight is looked into: its simulation, and its companion's decisions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import US_PER_MS
from airl_mav.latency.samplers import LatencySampler
from airl_mav.policy.observation import Kinematics
from airl_mav.prediction.compensator import Compensator
from airl_mav.scenario.resolved import ResolvedScenario
from airl_mav.view import messages
from airl_mav.view.ends import ViewEnds
from airl_mav.view.feed import Asked, Feed
from companion.pilot import Decided as Decision
from firmware_sim.autopilot.commander import Phase
from firmware_sim.engine.kinematics import POSITION, QUATERNION, VELOCITY
from firmware_sim.simulation import Simulation


class Hand:
    """What the watchers have set, as one companion flies by it."""

    def __init__(self, newest: Callable[[], messages.Steering], *, compensate: bool) -> None:
        """Take what gives the newest that they ask for, and whether the scenario compensates."""
        self.touched = False
        """Whether a decision of this flight was made otherwise than the scenario says."""
        self._newest = newest
        self._known = messages.Steering()
        self._as_asked = compensate

    def t2_us(self) -> int | None:
        """Return the viewer's latency for the next decision [µs]; None = the scenario's."""
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


VEHICLE_EVERY_US = 32_000
"""The vehicle is shown so often [simulated µs]: every eighth tick of 4 ms, 31 times a second."""

PICTURE_EVERY_US = 100_000
"""The camera's image is shown so often [simulated µs]."""


class SimulationTap:
    """Shows the simulation's side of flights. All calls from one thread."""

    def __init__(self, ends: ViewEnds, scenario: ResolvedScenario) -> None:
        """Connect to a view."""
        self._feed = Feed(ends)
        self._scenario = scenario
        self._vehicle_due = self._picture_due = -1

    def begin(self, seed: int, arena: Arena, started_us: int) -> None:
        """An episode begins, in an arena."""
        self._vehicle_due = self._picture_due = -1
        self._feed.send(
            messages.Episode(
                seed=seed,
                started_us=started_us,
                arena=arena,
                vehicle=messages.VehicleShape.of(self._scenario.vehicle),
                goal=arena.goal_point,
                goal_radius_m=self._scenario.pilot.goal_radius_m,
            )
        )

    def tick(
        self,
        simulation: Simulation,
        collision: str | None,
        pace: Callable[[int], None] = lambda _time_us: None,
    ) -> None:
        """Show the newest ticks.

        Args:
            simulation: Has flown them.
            collision: What has been hit so far.
            pace: Called after each state that was sent, with its time [µs].
        """
        flight, rotors = simulation.autopilot.flight, simulation.plant.rotor_speeds
        for time_us, motion, _, charge in simulation.truths.tolist():
            due = time_us // VEHICLE_EVERY_US
            if due == self._vehicle_due:
                continue
            self._vehicle_due = due
            self._feed.send(
                messages.Vehicle(
                    time_us=time_us,
                    position=tuple(motion[POSITION].tolist()),
                    velocity=tuple(motion[VELOCITY].tolist()),
                    quaternion=tuple(motion[QUATERNION].tolist()),
                    rotors=rotors,
                    battery=charge,
                    mode=flight.mode.name.lower().replace("_", " "),
                    armed=flight.phase >= Phase.GROUND,
                    collision=collision,
                )
            )
            pace(time_us)

    def frame(self, frame: Frame) -> None:
        """The camera has taken a frame."""
        due = frame.capture_time_us // PICTURE_EVERY_US
        if due == self._picture_due:
            return
        self._picture_due = due
        shown = messages.Picture(
            captured_us=frame.capture_time_us, shape=messages.shape_of(frame.image)
        )
        self._feed.send(shown, frame.image)

    def close(self) -> None:
        """Disconnect."""
        self._feed.close()


class CompanionTap:
    """Shows a companion's decisions and applies the viewers' latency; called from one thread."""

    def __init__(self, ends: ViewEnds, scenario: ResolvedScenario) -> None:
        """Connect to a view."""
        self._feed = Feed(ends)
        self._asked = Asked(ends, messages.Steering())
        self._scenario = scenario
        self._hand = self._new_hand()

    def _new_hand(self) -> Hand:
        return Hand(self._asked.newest, compensate=self._scenario.pilot.compensate)

    def begin(self) -> None:
        """A flight begins."""
        self._hand = self._new_hand()

    @property
    def touched(self) -> bool:
        """Whether the watchers have changed the latency or the compensation of this flight."""
        return self._hand.touched

    def latency(self, sampler: LatencySampler | None) -> LatencySampler:
        """Return a latency that the watchers may set, instead of the scenario's."""
        return HandLatency(self._hand, sampler)

    def compensator(self) -> Compensator | None:
        """Return one that the watchers may switch; None: nothing can be carried forward."""
        if not self._scenario.vehicle.compensable:
            return None
        return HandCompensator(self._hand, self._scenario)

    def decided(self, decision: Decision) -> None:
        """A decision was sent."""
        first, second, third, fourth = (float(number) for number in decision.setpoint)
        shown = messages.Decided(
            captured_us=decision.seen.frame.capture_time_us,
            began_us=decision.started_us,
            ready_us=decision.ready_us,
            sent_us=decision.sent_us,
            expires_us=decision.expires_us,
            setpoint=(first, second, third, fourth),
            commands=self._scenario.pilot.commands,
            compensated=self._scenario.vehicle.compensable and self._hand.compensates(),
            shape=messages.shape_of(decision.image),
        )
        self._feed.send(shown, decision.image)

    def close(self) -> None:
        """Disconnect."""
        self._asked.close()
        self._feed.close()
