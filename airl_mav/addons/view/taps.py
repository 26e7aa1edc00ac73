"""Sources of a view's messages: simulation, companion, rehearsal and lockstep flight."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing

import numpy as np
from numpy.typing import NDArray

from airl_mav.addons.view import view_messages as messages
from airl_mav.addons.view.view_messages import Flight, PhaseStart, Said
from airl_mav.addons.view.viewer import REAL_TIME, Asked, Feed, Pace
from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core import constants, frames
from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.latency.injection import LatencySampler
from airl_mav.policy.observation import Kinematics
from airl_mav.prediction import Compensator
from airl_mav.rehearsal import channel, live_view, observer
from airl_mav.scenario.resolve import ResolvedScenario
from companion.pilot import SentDecision
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.engine.dynamics import POSITION, QUATERNION, VELOCITY
from firmware_sim.simulation import Simulation


class Hand:
    """Viewers' settings for one companion's flight."""

    def __init__(self, newest: Callable[[], messages.Steering], *, compensate: bool) -> None:
        """Store the source of requests; `compensate` is the scenario's setting."""
        self.touched = False
        """True if a decision of this flight deviated from the scenario's settings."""
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
        return round(t2_ms * constants.US_PER_MS)

    def compensates(self) -> bool:
        """Return True if this decision is compensated."""
        wanted = self._known.compensate
        if wanted is None or wanted == self._as_asked:
            return self._as_asked
        self.touched = True
        return wanted


class HandLatency:
    """Latency that viewers may override. Implements `latency.injection.LatencySampler`."""

    def __init__(self, hand: Hand, sampler: LatencySampler | None) -> None:
        """Store the settings and the scenario's t2 sampler; None = no injected latency."""
        self._hand, self._sampler = hand, sampler

    def sample_us(self) -> int:
        """Return the next latency [µs]."""
        # Drawn in any case, so that the scenario's random sequence stays the same.
        drawn_us = 0 if self._sampler is None else self._sampler.sample_us()
        set_us = self._hand.t2_us()
        return drawn_us if set_us is None else set_us


class HandCompensator(Compensator):
    """Compensator that viewers may switch on and off in flight."""

    def __init__(self, hand: Hand, scenario: ResolvedScenario) -> None:
        """Create the compensator of a scenario, which requires a known vehicle response."""
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
        """Return the predicted depth and state, or the current ones while switched off."""
        if self._hand.compensates():
            return super().foresee(who, depth_mm, age_us, now_us, state)
        for i in who.tolist():
            self.forget(i)
        return depth_mm, state


VEHICLE_EVERY_US = 32_000
"""Period of vehicle messages [simulated µs]: every eighth tick of 4 ms, 31 Hz."""

PICTURE_EVERY_US = 100_000
"""Period of camera images [simulated µs]."""


class SimulationTap:
    """Sender of the simulation's messages. Call from one thread."""

    def __init__(self, ends: live_view.ViewAddresses, scenario: ResolvedScenario) -> None:
        """Connect to a view."""
        self._feed = Feed(ends)
        self._scenario = scenario
        self._vehicle_due = self._picture_due = -1

    def begin(self, seed: int, arena: Arena, started_us: int) -> None:
        """Send the start of an episode in an arena."""
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
        """Send the vehicle states of the newest ticks.

        Args:
            simulation: Source of the states.
            collision: Name of the obstacle hit so far; None without a collision.
            pace: Called after each sent state with its time [µs].
        """
        flight, rotors = simulation.autopilot.flight, simulation.plant.rotor_speeds
        for time_us, motion, _, charge in simulation.truths.tolist():
            due = time_us // VEHICLE_EVERY_US
            if due == self._vehicle_due:
                continue
            self._vehicle_due = due
            self._feed.send(
                messages.VehicleState(
                    time_us=time_us,
                    position=tuple(motion[POSITION].tolist()),
                    velocity=tuple(motion[VELOCITY].tolist()),
                    quaternion=tuple(motion[QUATERNION].tolist()),
                    rotors=rotors,
                    battery=charge,
                    mode=flight.mode.name.lower().replace("_", " "),
                    armed=flight.phase >= FlightPhase.GROUND,
                    collision=collision,
                )
            )
            pace(time_us)

    def frame(self, frame: Frame) -> None:
        """Send a new frame of the camera, if due."""
        due = frame.capture_time_us // PICTURE_EVERY_US
        if due == self._picture_due:
            return
        self._picture_due = due
        shown = messages.CameraImage(
            captured_us=frame.capture_time_us, shape=messages.shape_of(frame.image)
        )
        self._feed.send(shown, frame.image)

    def close(self) -> None:
        """Disconnect."""
        self._feed.close()


class CompanionTap:
    """Sender of a companion's decisions; applies viewers' settings. Call from one thread."""

    def __init__(self, ends: live_view.ViewAddresses, scenario: ResolvedScenario) -> None:
        """Connect to a view."""
        self._feed = Feed(ends)
        self._asked = Asked(ends, messages.Steering())
        self._scenario = scenario
        self._hand = self._new_hand()

    def _new_hand(self) -> Hand:
        return Hand(self._asked.newest, compensate=self._scenario.pilot.compensate)

    def begin(self) -> None:
        """Reset the viewers' settings for a new flight."""
        self._hand = self._new_hand()

    @property
    def touched(self) -> bool:
        """True if viewers changed the latency or the compensation of this flight."""
        return self._hand.touched

    def latency(self, sampler: LatencySampler | None) -> LatencySampler:
        """Return a sampler that lets viewers override the scenario's latency."""
        return HandLatency(self._hand, sampler)

    def compensator(self) -> Compensator | None:
        """Return a compensator that viewers may switch; None if the vehicle is unsupported."""
        if not self._scenario.vehicle.compensable:
            return None
        return HandCompensator(self._hand, self._scenario)

    def decided(self, decision: SentDecision) -> None:
        """Send a decision of the companion."""
        shown = messages.Decided(
            captured_us=decision.seen.frame.capture_time_us,
            began_us=decision.started_us,
            ready_us=decision.ready_us,
            sent_us=decision.sent_us,
            expires_us=decision.expires_us,
            setpoint=tuple(float(number) for number in decision.setpoint),
            commands=self._scenario.pilot.commands,
            compensated=self._scenario.vehicle.compensable and self._hand.compensates(),
            shape=messages.shape_of(decision.image),
        )
        self._feed.send(shown, decision.image)

    def close(self) -> None:
        """Disconnect."""
        self._asked.close()
        self._feed.close()


INFO = 6
"""MAV_SEVERITY_INFO."""


class ViewObserver(observer.Observer):
    """Reports to a view, and forwards all events to another observer."""

    def __init__(self, ends: live_view.ViewAddresses, onwards: observer.Observer) -> None:
        """Connect to a view."""
        self._feed = Feed(ends)
        self._onwards = onwards
        self.shows_states = onwards.shows_states

    def waiting(self, what: str) -> None:
        """Report the reason of a wait, such as the start of the processes, as the phase."""
        self._feed.send(PhaseStart(time_us=0, phase=what))
        self._onwards.waiting(what)

    def episode(self, index: int, seed: int, goal: frames.Goal) -> None:
        """Report the start of an episode."""
        self._feed.send(Flight(index=index, seed=seed, goal=goal))
        self._onwards.episode(index, seed, goal)

    def phase(self, phase: str, time_us: int) -> None:
        """Report the phase."""
        self._feed.send(PhaseStart(time_us=time_us, phase=phase))
        self._onwards.phase(phase, time_us)

    def state(self, state: channel.State, started_us: int) -> None:
        """Forward the state: the view gets it from the simulation, and more often."""
        self._onwards.state(state, started_us)

    def text(self, text: channel.Text) -> None:
        """Report a text of the autopilot."""
        self._feed.send(Said(time_us=text.time_us, severity=text.severity, text=text.text))
        self._onwards.text(text)

    def finished(self, record: EpisodeRecord) -> None:
        """Report the end of an episode."""
        how = f"flight {record.index:03d}: {record.outcome.value}, {record.reason}"
        self._feed.send(Said(time_us=record.ended_us, severity=INFO, text=how))
        for note in record.notes:
            self._feed.send(Said(time_us=None, severity=observer.WARNING, text=note))
        self._onwards.finished(record)

    def lost(self, what: str) -> None:
        """Report that an episode begins again."""
        self._feed.send(Said(time_us=None, severity=observer.WARNING, text=what))
        self._onwards.lost(what)

    def close(self) -> None:
        """Disconnect."""
        self._feed.close()


class FlightTap:
    """Connection of one flight to a viewer, until it is closed.

    Call the companion's methods on its thread, all others on the waiting conductor's thread.
    """

    def __init__(self, ends: live_view.ViewAddresses, scenario: ResolvedScenario) -> None:
        """Connect to a viewer; the pace is real time until a spectator changes it."""
        self._open = ExitStack()
        self._simulation = self._open.enter_context(closing(SimulationTap(ends, scenario)))
        self.companion = self._open.enter_context(closing(CompanionTap(ends, scenario)))
        """Companion's part of the connection."""
        self._pace = self._open.enter_context(closing(Pace(ends, scenario.speed or REAL_TIME)))

    def close(self) -> None:
        """Disconnect."""
        self._open.close()

    def begin(self, seed: int, arena: Arena, started_us: int) -> None:
        """Show the start of an episode, at a simulated time [µs]."""
        self._simulation.begin(seed, arena, started_us)

    def frame(self, frame: Frame) -> None:
        """Show a camera frame."""
        self._simulation.frame(frame)

    def tick(self, simulation: Simulation, collision: str | None) -> None:
        """Show the newest ticks, and wait as the pace requires."""
        self._simulation.tick(simulation, collision, self._pace.tick)
        self._pace.tick(simulation.time_us)

    def decided(self, decision: SentDecision) -> None:
        """Show an executed decision."""
        self.companion.decided(decision)
        self._pace.decided()
