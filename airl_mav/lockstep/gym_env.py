"""`airl/Rehearsal-v0`: a lockstep rehearsal with Gymnasium's API, one step per decision."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import reduce
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from airl_mav.core.errors import FieldError
from airl_mav.envs.draws import source_of
from airl_mav.envs.fleet import FlightArrays
from airl_mav.envs.navigation_env import (
    action_space,
    checked_actions,
    draw_seeds,
    episode_seed,
    observation_space,
    zone_option,
)
from airl_mav.envs.observations import sight_of
from airl_mav.envs.rendering import RENDER_MODES, Pictures
from airl_mav.envs.rewards import Step, costs, reward_of
from airl_mav.envs.spec import EnvironmentSpec, gymnasium_spec
from airl_mav.envs.stopping import bounded, injections_of
from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.asked_flight import AskedFlight
from airl_mav.policy.actions import command, commands
from airl_mav.policy.layouts import Encoded, encode_layout, newest_frame
from airl_mav.policy.observation import Observation
from airl_mav.policy.registry import PolicyInfo
from airl_mav.profiles.conditions import SensorNoise, Spread
from airl_mav.rehearsal.run_folder import FlownEpisode
from airl_mav.scenario.model import Scenario, WatchdogSettings
from airl_mav.scenario.resolve import ResolvedScenario, resolve
from firmware_sim.warm_up import warm_up

BESIDE = (
    "firmware",
    "real",
    "plant",
    "estimator",
    "renderer",
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

TWIN_ALONE = (
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
    for name in TWIN_ALONE:
        value, accepted = (reduce(getattr, name.split("."), each) for each in (spec, usual))
        if value != accepted:
            raise FieldError(name, value, f"{accepted}: only the batch twin has another")
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
                vectorized simulator, or there is no display.
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
        self.observation_space: gym.Space[Any] = observation_space(self._sees)
        self.action_space = action_space(actions)
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
            zone = zone_option(options)
            scenario = self._resolved.scenario.model_copy(update={"zone": zone})
            self._resolved = replace(self._resolved, scenario=scenario)
        super().reset(seed=seed)
        # Without a seed, the episode's seed comes from the environment's generator.
        self._seed = draw_seeds(self.np_random, 1)[0] if seed is None else episode_seed(seed)
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
        number = checked_actions(spec, action, ())
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
        """Return the current frame (540, 960, 3) for `rgb_array`; windows update automatically."""
        return self._pictures.render()

    def close(self) -> None:
        """End a running flight and close the window."""
        self._end()
        self._pictures.close()

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
