"""Lockstep flight that exchanges observations and actions with an external caller."""

from __future__ import annotations

import math
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Thread, main_thread

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.core.constants import TICK_S, US_PER_S, CommandKind
from airl_mav.core.frames import goal_distance_m, quat_yaw
from airl_mav.envs.arena_batch import CEILING, FLOOR, NOTHING, WALL
from airl_mav.envs.fleet import FlightArrays, FlightStatus
from airl_mav.envs.rendering import PictureContent
from airl_mav.flight.judge import Outcome, Referee
from airl_mav.lockstep.lockstep_flight import LockstepFlight
from airl_mav.policy.actions import Action, AnyAction, BodyRates
from airl_mav.policy.observation import Observation
from airl_mav.rehearsal.run_folder import FlownEpisode
from airl_mav.scenario.resolve import ResolvedScenario
from firmware_sim.engine.record import TRUE_TICK
from firmware_sim.simulation import Simulation

VERDICTS = {
    Outcome.SUCCESS: FlightStatus.SUCCESS,
    Outcome.COLLISION: FlightStatus.COLLISION,
    Outcome.BATTERY: FlightStatus.BATTERY,
    Outcome.TIMEOUT: FlightStatus.TIMEOUT,
    # Aborted flights count neither as success nor as failure of the policy.
    Outcome.ABORTED: FlightStatus.FLYING,
}

IDLE: dict[CommandKind, AnyAction] = {
    "velocity": Action(0.0, 0.0, 0.0),
    "body_rates": BodyRates(0.0, 0.0, 0.0, 0.0),
}
"""Action returned to the companion of an aborted flight; its setpoint is not sent."""

LEAVING_S = 0.2
"""Interval at which a flight waiting for an action checks for program exit [wall s]."""


class AskedFlight:
    """Flight on a separate thread that blocks until it receives an action or the program exits.

    Implements `actions.Policy` for the companion. Call all other methods from one other thread.
    They return while the flight is blocked, so its state is constant.
    """

    def __init__(self, resolved: ResolvedScenario, seed: int) -> None:
        """Start a flight: take off and request the first action."""
        # The flight's thread puts events; the caller of `step` puts answers.
        self._events: SimpleQueue[Observation | FlownEpisode | BaseException] = SimpleQueue()
        self._answers: SimpleQueue[AnyAction] = SimpleQueue()
        self._idle = IDLE[resolved.pilot.commands]
        self._flight = LockstepFlight(
            resolved,
            self,
            0,
            seed,
            patience_s=math.inf,
            lands=False,  # After a timeout, observations only report the vehicle's state.
            ticked=lambda *seen: self._account.ticked(*seen),
        )
        self._account = _Account(self._flight.arena)
        self._end: FlownEpisode | BaseException | None = None
        # Not a daemon thread: MAVSDK is already destroyed when daemon threads end.
        self._thread = Thread(target=self._fly, name="rehearsal")
        self._thread.start()

    def act(self, observation: Observation) -> AnyAction:
        """Request an action, on the companion's thread."""
        self._events.put(observation)
        while main_thread().is_alive():
            with suppress(Empty):
                return self._answers.get(timeout=LEAVING_S)
        self._flight.call_off()
        return self._idle

    def asked(self) -> Observation | FlownEpisode:
        """Return the observation for the next action, or the finished flight.

        Raises:
            UsageError: The scenario cannot be flown.
            LockstepError: The companion hangs or raised an error.
            FirmwareLostError: Real firmware was lost.
        """
        event = self._events.get()
        if not isinstance(event, Observation):
            self._end = event
        if isinstance(event, BaseException):
            raise event
        return event

    def answer(self, action: AnyAction) -> Observation | FlownEpisode:
        """Apply an action; return the next observation, or the finished flight."""
        self._answers.put(action)
        return self.asked()

    def flights(self) -> FlightArrays:
        """Return the state of the flight, frozen at its verdict: arrays (1,)."""
        return self._account.flights()

    def outcome(self) -> Outcome | None:
        """Return the outcome; None = not decided yet."""
        return self._account.outcome()

    def moment(self, image: NDArray[np.uint8]) -> PictureContent:
        """Return the rendering data of the current time, with the policy's input image."""
        return self._account.moment(image)

    def end(self) -> FlownEpisode | None:
        """Abort the flight if it is still running; return the finished flight.

        Returns None if the flight ended with an error.
        """
        if self._end is None:
            self._flight.call_off()
            self._answers.put(self._idle)
            while isinstance(event := self._events.get(), Observation):
                self._answers.put(self._idle)
            self._end = event
        self._thread.join()
        return self._end if isinstance(self._end, FlownEpisode) else None

    def _fly(self) -> None:
        try:
            event: FlownEpisode | BaseException = self._flight.fly()
        except BaseException as error:  # raised in the caller's thread
            event = error
        self._events.put(event)


class _Account:
    """Metrics of a flight, updated every tick as in the vectorized simulator."""

    def __init__(self, arena: Arena) -> None:
        self._arena = arena
        self._simulation: Simulation | None = None
        self._referee: Referee | None = None
        self._hit: str | None = None
        self._newest = np.zeros((), TRUE_TICK)
        """True state of the newest tick, or of the verdict."""
        self._distance_m = self._energy_j = 0.0
        self._at_verdict: FlightArrays | None = None

    def ticked(self, simulation: Simulation, referee: Referee, hit: str | None) -> None:
        """Process the true states of the newest ticks."""
        truths, verdict = simulation.truths, referee.verdict
        self._simulation, self._referee, self._hit = simulation, referee, hit
        # Distance and energy count from the start of navigation to the verdict.
        if referee.navigation_us is None or self._at_verdict is not None:
            self._newest = truths[-1].copy()
            return
        # The last call may contain ticks after the verdict.
        if verdict is not None:
            truths = truths[truths["time_us"] <= verdict.time_us]
        # The newest position of the last call joins the polyline.
        places = np.vstack([self._newest["motion"][None, :3], truths["motion"][:, :3]])
        self._distance_m += float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
        self._energy_j += float(truths["power_w"].sum()) * TICK_S
        self._newest = truths[-1].copy()
        # The state at the verdict is kept: later ticks do not change it.
        if verdict is not None:
            self._at_verdict = self._now()

    def flights(self) -> FlightArrays:
        """Return the state of the flight, frozen at its verdict."""
        return self._at_verdict or self._now()

    def outcome(self) -> Outcome | None:
        """Return the outcome; None = not decided yet."""
        verdict = None if self._referee is None else self._referee.verdict
        return None if verdict is None else verdict.outcome

    def moment(self, image: NDArray[np.uint8]) -> PictureContent:
        """Return the data of a rendered frame at the current time."""
        simulation, _ = self._flown()
        truth, scene_us = simulation.truth, simulation.time_us - simulation.start_us
        yaw = quat_yaw(truth.quaternion)
        return PictureContent(
            self._arena, self.flights(), np.array(truth.position), yaw, scene_us, image
        )

    def _flown(self) -> tuple[Simulation, Referee]:
        assert self._simulation is not None  # noqa: S101 (set by the first tick)
        assert self._referee is not None  # noqa: S101
        return self._simulation, self._referee

    def _now(self) -> FlightArrays:
        _, referee = self._flown()
        tick, outcome = self._newest, self.outcome()
        time_us, motion = int(tick["time_us"]), tick["motion"]
        # Before navigation, times count from now and are zero.
        began_us = time_us if referee.navigation_us is None else referee.navigation_us
        return FlightArrays(
            verdict=np.array(
                [FlightStatus.FLYING if outcome is None else VERDICTS[outcome]], np.int64
            ),
            time_s=np.array([(time_us - began_us) / US_PER_S]),
            distance_m=np.array([self._distance_m]),
            energy_j=np.array([self._energy_j]),
            goal_distance_m=np.array([goal_distance_m(referee.task.goal, motion[:3])]),
            speed_m_s=np.array([np.linalg.norm(motion[3:6])]),
            battery=np.array([tick["charge"]]),
            touched=np.array([self._touched()]),
        )

    def _touched(self) -> int:
        """Return the index of the object that was hit, as numbered by the vectorized simulator."""
        room = {None: NOTHING, "floor": FLOOR, "wall": WALL, "ceiling": CEILING}
        if self._hit in room:
            return room[self._hit]
        names = map(self._arena.name_of, range(len(self._arena.obstacles)))
        return next((i for i, name in enumerate(names) if name == self._hit), NOTHING)
