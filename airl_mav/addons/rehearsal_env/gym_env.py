"""`airl/Rehearsal-v0`: a lockstep rehearsal with Gymnasium's API, one step per decision."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import reduce
from queue import Empty, SimpleQueue
from threading import Thread, main_thread
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.geometry import Arena
from airl_mav.core.constants import TICK_S, US_PER_S, CommandKind
from airl_mav.core.errors import FieldError
from airl_mav.core.frames import goal_distance_m, quat_yaw
from airl_mav.envs import navigation_env
from airl_mav.envs.arena_batch import CEILING, FLOOR, NOTHING, WALL
from airl_mav.envs.draws import source_of
from airl_mav.envs.fleet import FlightArrays, FlightStatus
from airl_mav.envs.observations import sight_of
from airl_mav.envs.rendering import RENDER_MODES, PictureContent, Pictures
from airl_mav.envs.rewards import Step, costs, reward_of
from airl_mav.envs.spec import EnvironmentSpec, gymnasium_spec
from airl_mav.envs.stopping import bounded, injections_of
from airl_mav.flight.judge import Outcome, Referee
from airl_mav.lockstep.lockstep_flight import LockstepFlight
from airl_mav.policy.actions import Action, AnyAction, BodyRates, command, commands
from airl_mav.policy.layouts import Encoded, encode_layout, newest_frame
from airl_mav.policy.observation import Observation
from airl_mav.policy.registry import PolicyInfo
from airl_mav.profiles.vehicle import SensorNoise, Spread
from airl_mav.rehearsal.run_folder import FlownEpisode
from airl_mav.scenario.model import Scenario, WatchdogSettings
from airl_mav.scenario.resolve import ResolvedScenario, resolve
from firmware_sim.engine.record import TRUE_TICK
from firmware_sim.simulation import Simulation
from firmware_sim.warm_up import warm_up

BESIDE = (
    "firmware",
    "real",
    "plant",
    "estimator",
    "faults",
    "payload",
    "battery_charge",
    "origin",
    "limits",
    "arena_seed",
    "latency_seed",
    "speed",
    "start",
)
"""Fields of a `Scenario` that an `EnvironmentSpec` lacks."""

GYM_ALONE = (
    "camera",
    "curriculum",
    "delay.native_ms",
    "delay.transport_ms",
    "delay.link_ms",
    "randomisation.estimation",
    "randomisation.extra_delay_ms",
)
"""Fields of an `EnvironmentSpec` that only the vectorized simulator supports."""


def scenario_of(spec: EnvironmentSpec, beside: Mapping[str, Any]) -> Scenario:
    """Return the scenario, without a policy; of several t2 sources it uses the first.

    Args:
        spec: Specification of the environment.
        beside: Values of the fields `BESIDE`, without defaults.

    Raises:
        FieldError: A field has a wrong type, is out of range, or needs the vectorized simulator.
    """
    # Settings that only the vectorized simulator supports must have their default.
    usual = EnvironmentSpec()
    for name in GYM_ALONE:
        value, accepted = (reduce(getattr, name.split("."), each) for each in (spec, usual))
        if value != accepted:
            raise FieldError(name, value, f"{accepted}: only the vectorized simulator has another")
    rules, delay, drawn = spec.episode, spec.delay, spec.randomisation
    return Scenario(
        level="lockstep",
        vehicle=spec.vehicle,
        arena=spec.arena,
        hold_s=rules.hold_s,
        altitude_m=rules.altitude_m,
        goal_radius_m=rules.goal_radius_m,
        time_limit_s=rules.time_limit_s,
        max_speed_m_s=spec.max_speed_m_s,
        decisions=spec.decisions,
        compensate=spec.compensate,
        watchdog=WatchdogSettings(
            hover_after_s=rules.hover_after_s, decision_timeout_s=rules.decision_timeout_s
        ),
        computer=delay.computer,
        workload=delay.workload,
        latency=delay.latency[0] if delay.latency else None,
        wind=spec.wind,
        spread={name: getattr(drawn, name) for name in Spread.model_fields},
        sensors={name: getattr(drawn, name) for name in SensorNoise.model_fields},
        **beside,
    )


class RehearsalEnv(gym.Env[Encoded, Any]):
    """Gymnasium environment that flies one vehicle to its goal through the full flight stack.

    Spaces, actions, rewards, `info` and keyword arguments are the same as in `NavigationEnv`
    (`airl/Navigation-v0`). Every flight runs at level lockstep: plant, flight controller (also
    PX4), MAVLink, MAVSDK and the companion, which gets its actions from `step`. `reset` takes off.
    The landing after the last step of an episode is not flown.

    A flight without success or failure is truncated with outcome `aborted`, for example when the
    companion ends it at a limit. The last observation is the input of the next decision. After a
    crash, which ends all decisions, it is the newest observation.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 2}  # noqa: RUF012

    def __init__(
        self, spec: EnvironmentSpec | None = None, *, render_mode: str | None = None, **knobs: Any
    ) -> None:
        """Create the environment; nothing is started.

        Args:
            spec: Specification of the environment; without it, `knobs` contains its fields.
            render_mode: See `NavigationEnv`.
            knobs: Fields of an EnvironmentSpec if `spec` is missing, and in both cases Scenario
                fields that an EnvironmentSpec lacks: firmware, real, plant, faults and the others
                of `spec_scenario.BESIDE`.

        Raises:
            UsageError: An option or a profile cannot be used, an option is supported only by the
                vectorized simulator.
        """
        # Settings of the flight beside those of the environment.
        beside = {name: knobs.pop(name) for name in BESIDE if name in knobs}
        self.environment = bounded(gymnasium_spec(spec, knobs))
        self._reward = reward_of(self.environment.reward)
        actions = self.environment.action_spec
        asked = PolicyInfo("asked", "decides by Gymnasium's API", asked=actions.commands)
        self._resolved: ResolvedScenario = resolve(scenario_of(self.environment, beside), asked)
        self._sees = sight_of(self.environment, self._resolved.vehicle).observation
        # The goal's dimension comes from the arena of the first seed.
        flat = len(self._resolved.arena_of(self._resolved.scenario.seed).goal_point) == 2
        if self._sees.goal_height and flat:
            accepted = f"false in arena {self.environment.arena!r}, whose goals have none"
            raise FieldError("goal_height", True, accepted)
        self.render_mode = render_mode
        self._pictures = Pictures(self.environment, self._sees.kind, render_mode)
        self.metadata = self.metadata | self._pictures.metadata
        # Several sources of t2 are drawn per episode, see `reset`.
        self._sources = injections_of(self.environment.delay)
        # Kernels compile here instead of in the first episode.
        warm_up(self._resolved.vehicle, self._resolved.scenario.plant)
        self.observation_space: gym.Space[Any] = navigation_env.observation_space(self._sees)
        self.action_space = navigation_env.action_space(actions)
        self.flown: FlownEpisode | None = None
        """Newest completed episode: record, true trajectory, latencies."""
        self._flight: AskedFlight | None = None
        self._ending: Any = None
        self._seed = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Encoded, dict[str, Any]]:
        """Take off and return the observation for the first decision.

        Args:
            seed: See `NavigationEnv.reset`.
            options: See `NavigationEnv.reset`.

        Raises:
            UsageError: An option or the seed is invalid, the seed gives no valid arena, or PX4 is
                missing.
            LockstepError: The companion hangs or raised an error.
            gymnasium.error.Error: The seed is negative, or the vehicle has not taken off.
        """
        # A running flight ends before the next one starts.
        self._end()
        if seed is not None or options:
            zone = navigation_env.zone_option(options)
            scenario = self._resolved.scenario.model_copy(update={"zone": zone})
            self._resolved = replace(self._resolved, scenario=scenario)
        super().reset(seed=seed)
        # Without a seed, the episode's seed comes from the environment's generator.
        self._seed = (
            navigation_env.draw_seeds(self.np_random, 1)[0]
            if seed is None
            else navigation_env.episode_seed(seed)
        )
        resolved = self._resolved
        if len(self._sources) > 1:
            resolved = replace(resolved, injection=source_of(self._sources, self._seed))
        flight = AskedFlight(resolved, self._seed)
        # The finalizer ends the thread of a flight that is never closed.
        self._flight, self._ending = flight, weakref.finalize(self, flight.end)
        self._ending.atexit = False  # The flight handles program exit.
        # The first event is the observation of the first decision, or the end of a failed
        # take-off.
        asked = self._heard(flight.asked)
        if isinstance(asked, FlownEpisode):
            raise gym.error.Error(f"seed {self._seed}: it has not taken off: {asked.record.reason}")
        self._pictures.begin()
        self._newest = self._encode(asked)
        self._look(flight)
        self._before = flight.flights()
        # Body rates have four numbers; velocities at a held altitude have three.
        by_rates = self.environment.action_spec.commands == "body_rates"
        self._last = np.zeros((1, 4 if by_rates else 3))
        return self._seen(), self._info(self._before)

    def step(self, action: Any) -> tuple[Encoded, float, bool, bool, dict[str, Any]]:
        """Fly one decision; see Gymnasium's Env.step.

        Raises:
            ResetNeeded: No episode has begun, or the episode has ended.
            InvalidAction: The action is not in the action set; numbers outside -1..1 are clipped.
            LockstepError: The companion hangs or raised an error.
            FirmwareLostError: Real firmware was lost; the episode is over.
        """
        flight, spec = self._flight, self.environment.action_spec
        if flight is None:
            raise gym.error.ResetNeeded(
                "step() without an episode that goes on: reset() begins one"
            )
        # Checked before the flight continues: an invalid action changes nothing.
        number = navigation_env.checked_actions(spec, action, ())
        asked = self._heard(lambda: flight.answer(command(spec, number)))
        # Reward terms compare the state before and after the decision.
        before, now, outcome = self._before, flight.flights(), flight.outcome()
        level = commands(spec, number[None])[:, : self._last.shape[1]]
        step = Step(before, now, level, self.environment.episode.hold_s)
        reward = self._reward(step) - costs(self.environment.costs, self._last, step)
        self._before, self._last = now, level
        # After the last decision the newest observation is returned again.
        if isinstance(asked, Observation):
            self._newest = self._encode(asked)
        self._look(flight)
        info = self._info(now)
        if outcome is not None:
            info |= {"success": outcome is Outcome.SUCCESS, "outcome": outcome.value}
            self.flown = flight.end()
            self._end()
        # Gymnasium: a timeout is a truncation, an end by the flight itself a termination.
        truncated = outcome in (Outcome.TIMEOUT, Outcome.ABORTED)
        terminated = outcome is not None and not truncated
        return self._seen(), float(reward[0]), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the current frame (540, 960, 3) for `rgb_array`."""
        return self._pictures.render()

    def close(self) -> None:
        """End a running flight."""
        self._end()

    def _end(self) -> None:
        if self._ending is not None:
            self._ending()
        self._flight = self._ending = None

    def _heard(self, ask: Callable[[], Observation | FlownEpisode]) -> Observation | FlownEpisode:
        """Return the flight's next observation or its result; end the flight on any error."""
        try:
            return ask()
        except BaseException:  # Ctrl-C, too: the next request would get a stale answer.
            self._end()
            raise

    def _encode(self, asked: Observation) -> Encoded:
        return {key: rows[0] for key, rows in encode_layout(self._sees, asked.rows(None)).items()}

    def _look(self, flight: AskedFlight) -> None:
        if self._pictures.wanted:
            self._pictures.see(flight.moment(newest_frame(self._sees, self._newest)))

    def _seen(self) -> Encoded:
        """Return a copy of the newest observation, which the caller may modify."""
        return {key: array.copy() for key, array in self._newest.items()}

    def _info(self, now: FlightArrays) -> dict[str, Any]:
        zone = self._resolved.scenario.zone
        return {
            "seed": self._seed,
            "zone": -1 if zone is None else zone,
            "flight_time_s": float(now.time_s[0]),
            "distance_m": float(now.distance_m[0]),
            "energy_j": float(now.energy_j[0]),
            "goal_distance_m": float(now.goal_distance_m[0]),
        }


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
