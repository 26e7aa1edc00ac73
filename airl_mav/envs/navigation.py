"""N flights at a time: the companion's decision loop around the batch twin.

A decision, as `companion.pilot` flies it: the frame was taken a moment ago, the state is that of
now; while the network computes, and until its setpoint arrives, the last one keeps flying. The
hold counts from when the setpoint is sent, so that a decision takes t2 and the hold, not the link
as well. Everything is in ticks of simulated time, so nothing depends on the machine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import TICK_US, US_PER_MS, US_PER_S, CommandKind
from airl_mav.core.errors import FieldError
from airl_mav.core.streams import Stream, stream
from airl_mav.envs.arenas import ArenaBatch, move_all_obstacles
from airl_mav.envs.cameras import Cameras
from airl_mav.envs.companions import Companions
from airl_mav.envs.delay import injections_of
from airl_mav.envs.draws import DelayDraws
from airl_mav.envs.encoding import COMPILED
from airl_mav.envs.episode_arenas import EpisodeArenas
from airl_mav.envs.estimation import Telemetry
from airl_mav.envs.faults import later_us, twin_faults
from airl_mav.envs.fleet import (
    STILL,
    Fleet,
    Rules,
    Vehicle,
    Verdict,
    hover,
    new_fleet,
    put_vehicle,
    vehicle_of,
)
from airl_mav.envs.flight import advance
from airl_mav.envs.legs import Legs
from airl_mav.envs.rate_setpoints import RateSetpoints
from airl_mav.envs.saved_state import State, Stateful
from airl_mav.envs.sight import check_conditions, sight_of
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.envs.timing import PipelinedTiming, SequentialTiming, give, ticks_of
from airl_mav.envs.trace import Trace
from airl_mav.envs.winds import Winds
from airl_mav.faults.model import Fault, check_twin
from airl_mav.latency.injection import Injection
from airl_mav.policy.actions import UPRIGHT_S, vertical_speeds
from airl_mav.policy.layouts import encode_layout
from airl_mav.policy.observation import Kinematics, Observation, Rows, observe
from airl_mav.policy.observation_spec import Encoded, ObservationSpec
from airl_mav.prediction.compensator import Compensator
from airl_mav.profiles.arena import OBSTACLES, ArenaSpec
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.conditions import Payload
from airl_mav.profiles.loaded import check_spread, equipped
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.parameters import flown_values
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.vehicle.airframe import draw_airframe, spreads

EVERYONE = slice(None)
"""The rows of all n vehicles."""


@dataclass(frozen=True)
class Flights:
    """Status of n flights; arrays (n,)."""

    verdict: NDArray[np.int64]
    """`fleet.Verdict`."""
    time_s: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    """Flown so far [m]."""
    energy_j: NDArray[np.float64]
    goal_distance_m: NDArray[np.float64]
    """True; seen from above, where the goal has no height."""
    speed_m_s: NDArray[np.float64]
    """Three-dimensional, true."""
    battery: NDArray[np.float64]
    """Charge left, 1 to 0."""
    touched: NDArray[np.int64]
    """Index of the obstacle that is touched, or `contact.FLOOR`, `CEILING`, `WALL`, `NOTHING`."""

    def with_rows(self, rows: Rows, others: Flights) -> Flights:
        """Return these with `others` in their rows."""
        replaced = {name: array.copy() for name, array in vars(self).items()}
        for name, array in replaced.items():
            array[rows] = getattr(others, name)
        return Flights(**replaced)


class WholeTruth(NamedTuple):
    """What no policy is told, for experts that are imitated."""

    fleet: Fleet
    arenas: ArenaBatch
    vehicle: Vehicle


class Navigation(Stateful):
    """N vehicles, each flying to its goal. No slot resets by itself."""

    def __init__(
        self,
        spec: EnvironmentSpec,
        n: int,
        *,
        vehicle: VehicleProfile | None = None,
        arena: ArenaSpec | None = None,
        injection: Injection | None = None,
        latency_draw: int = 0,
        arena_seed: int | None = None,
        trace: Trace | None = None,
        computer_w: float = 0.0,
        battery_charge: float = 1.0,
        compensator: Compensator | None = None,
        faults: Sequence[Fault] = (),
        commands: CommandKind | None = None,
    ) -> None:
        """Load the profiles.

        Args:
            spec: The environment.
            n: Number of vehicles.
            vehicle: The vehicle with all that it carries, where it has been loaded; None: that of
                `spec`, with the computer of `spec.delay` on board.
            arena: The same of the arena.
            injection: Source of t2; None: that of `spec.delay`.
            latency_draw: Another number gives other draws of the same latency.
            arena_seed: Seed of arena and goal of all episodes; None: each episode's own.
            trace: Records the flights; None records nothing, and changes nothing.
            computer_w: What the computer on board of that `vehicle` draws from the pack [W].
            battery_charge: State of charge at the start of every flight, 1 full to 0 empty.
            compensator: Carries forward what is seen, of n companions; None: that of the vehicle,
                where `spec` compensates.
            faults: What happens in every flight, of what the twin has (`envs.faults`); no part of
                a saved state.
            commands: What `fly` is given, velocity or body_rates; None: what the actions of `spec`
                command.

        Raises:
            UsageError: A profile cannot be used, or the camera does not serve the layout; a fault
                is none that the twin can fly.
        """
        self.spec = spec
        self.n = n
        self.by_rates: bool = (commands or spec.action_spec.commands) == "body_rates"
        """Whether body rates and thrusts are commanded, and not velocities."""
        if vehicle is None:
            vehicle, computer = equipped(spec.vehicle, spec.delay.computer, Payload())
            computer_w = computer.onboard_watts
        self.vehicle: VehicleProfile = vehicle
        self.arena_spec: ArenaSpec = arena or load_profile("arenas", spec.arena, ArenaSpec)
        sight = sight_of(spec, self.vehicle)
        self.camera: Camera = sight.camera
        self.observation: ObservationSpec = sight.observation
        self.intrinsics: Intrinsics = sight.intrinsics
        known = self.arena_spec.generator == OBSTACLES
        if spec.goal_height and known and self.arena_spec.goal.height_m is None:
            raise FieldError(
                "goal_height",
                True,
                f"false in arena {spec.arena!r}, whose profile has no goal.height_m",
            )
        self.injections = injections_of(spec.delay) if injection is None else (injection,)
        self._trace = trace
        parameters = flown_values(self.vehicle.autopilot_parameters())
        self._vehicle = vehicle_of(self.vehicle, parameters.__getitem__, computer_w)
        self._charge = battery_charge
        rules = spec.episode
        self._rules = Rules(rules.goal_radius_m, round(rules.time_limit_s * US_PER_S))
        self._hold_us = round(rules.hold_s * US_PER_S)
        self._transport_us = round(spec.delay.transport_ms * US_PER_MS)
        self._link_us = round(spec.delay.link_ms * US_PER_MS)
        hover_s = rules.hover_after_s
        self._hover_us = None if hover_s is None else round(hover_s * US_PER_S)
        self._places = EpisodeArenas(
            spec,
            self.arena_spec,
            n,
            self.vehicle.body.width_m,
            arena_seed,
            looks=sight.coloured,
        )
        self.stages, self.arenas = self._places.stages, self._places.present
        self.seeds, self.zones = self._places.seeds, self._places.zones
        self.fleet, self._calm_start = new_fleet(n), new_fleet(1)
        hover(self._calm_start, 0, rules.altitude_m, self._vehicle, battery=battery_charge)
        self._decision = np.zeros(n, np.int64)
        self._extra_us = np.zeros(n, np.int64)
        self._delays = DelayDraws(
            n, self.injections, round(spec.delay.native_ms * US_PER_MS), draw=latency_draw
        )
        randomisation = spec.randomisation
        check_spread(self.vehicle, randomisation, "randomisation")
        check_conditions(sight, spec, faults)
        table = self.vehicle.estimation if randomisation.estimation else None
        self._telemetry = Telemetry(n, table, randomisation.navigation_noise)
        pipelined = spec.decisions == "pipelined"
        check_twin(faults, pipelined=pipelined)
        self._winds = Winds(n, spec.wind, faults)
        self.cameras = Cameras(
            n,
            self.camera,
            self._transport_us,
            randomisation,
            faults,
            self._places.looks,
            self._places.meshes,
            sight.further,
        )
        self._uplink = twin_faults(faults, "uplink")
        self._timing: SequentialTiming | PipelinedTiming
        rates = None
        if self.by_rates:
            held_s = 0.0 if pipelined else rules.hold_s
            timeout_s = rules.decision_timeout_s or held_s + UPRIGHT_S
            rates = RateSetpoints(n, round(timeout_s * US_PER_S))
        if pipelined:
            self._timing = PipelinedTiming(n, self._link_us, rates)
        else:
            self._timing = SequentialTiming(
                self.cameras, self._link_us, self._hold_us, self._hover_us, self._uplink, rates
            )
        if compensator is None and spec.compensate:
            compensator = Compensator(n, self.vehicle, self.intrinsics)
        self._companions = Companions(
            n,
            self.intrinsics,
            compensator=compensator,
            told=bool(spec.in_flight),
            earlier=spec.frames - 1,
            further={
                name: (lens, spec.cameras[name].frames - 1) for name, lens in sight.lenses.items()
            },
        )

    def begin(self, slots: Sequence[int], seeds: Sequence[int], zone: int | None = None) -> None:
        """Start episodes: each in a hover above its start, the first frame taken.

        Args:
            slots: Which of the n.
            seeds: Of the episodes, one a slot.
            zone: Curriculum zone, or stage, that bounds the goals; None is the whole arena.

        Raises:
            UsageError: No arena can be made of a seed, or there is no such zone.
        """
        self._places.check_zone(zone)
        who = np.zeros(self.n, np.bool_)
        for i, seed in zip(slots, seeds, strict=True):
            self._begin(i, int(seed), zone)
            who[i] = True
        self.capture(who)
        self._look_ahead(who)

    def prepare(self, seeds: Sequence[int], zone: int | None = None) -> None:
        """Make the arenas of episodes that are likely to begin soon; see `EpisodeArenas`."""
        self._places.prepare(seeds, zone)

    def prepared(self, seeds: Sequence[int], zone: int | None = None) -> bool:
        """Return whether all of these arenas have been made ahead."""
        return self._places.prepared(seeds, zone)

    def _begin(self, i: int, seed: int, zone: int | None) -> None:
        self._places.begin(i, seed, zone)
        randomisation = self.spec.randomisation
        airframe = None
        if spreads(randomisation):
            rng = stream(seed, Stream.AIRFRAME)
            airframe = draw_airframe(self._vehicle.airframe, randomisation, rng)
        north, east, down = self._winds.begin(i, seed).tolist()
        wind = (north, east, down)
        if airframe is None and wind == STILL:
            put_vehicle(self.fleet, i, self._calm_start, 0)
        else:
            altitude_m = self.spec.episode.altitude_m
            hover(self.fleet, i, altitude_m, self._vehicle, airframe, self._charge, wind)
        if self._trace is not None:
            self._trace.begin(i, self.fleet)
        self._decision[i] = 0
        low, high = randomisation.extra_delay_ms
        extra_ms = low if low == high else stream(seed, Stream.DELAY).uniform(low, high)
        self._extra_us[i] = round(extra_ms * US_PER_MS)
        self._delays.begin(i, seed)
        self._telemetry.begin(i, seed)
        self.cameras.begin(i, seed)
        self._timing.begin(i)
        self._companions.begin(i)

    def see(self, slots: Sequence[int] | None = None) -> Observation:
        """Return the present observations of all vehicles, or of those in `slots`.

        With a leading axis (n,). Where latency is compensated, they are those of when the decision
        is expected to act.
        """
        rows, known = EVERYONE if slots is None else slots, self._companions
        if known.foresee:
            image, state = known.foreseen(rows)
        else:
            image, state = self.cameras.image[rows], self.kinematics(rows)
        goal = self._places.batch.goal[rows]
        if np.isnan(goal[:, 2]).all():
            goal = goal[:, :2]
        eyes = self.cameras.further
        lenses = {name: each.intrinsics for name, each in eyes.items()}
        views = known.views(self._further_images(), lenses, rows)
        return observe(
            *(image, self.intrinsics, state, goal, known.told(rows), known.earlier(rows)), views
        )

    def _further_images(self) -> dict[str, NDArray[Any]]:
        return {name: each.image for name, each in self.cameras.further.items()}

    def observe(self, slots: Sequence[int] | None = None) -> Encoded:
        """Return the present observations in the environment's layout.

        Of all vehicles, or of those in `slots`.
        """
        return encode_layout(self.observation, self.see(slots), COMPILED)

    def kinematics(self, rows: Rows = EVERYONE) -> Kinematics:
        """Return the state of all n as telemetry reports it: with the estimator's error."""
        return self._telemetry.report(self.truth(rows), rows)

    def flights(self, rows: Rows = EVERYONE) -> Flights:
        """Return the status of all flights, or of those in `rows`; copies."""
        fleet = self.fleet
        to_goal = self._places.batch.goal[rows] - fleet.position[rows]
        away, below = np.hypot(to_goal[:, 0], to_goal[:, 1]), to_goal[:, 2]
        return Flights(
            verdict=np.array(fleet.verdict[rows]),
            time_s=fleet.time_us[rows] / US_PER_S,
            distance_m=np.array(fleet.distance[rows]),
            energy_j=np.array(fleet.energy[rows]),
            goal_distance_m=np.where(np.isnan(below), away, np.hypot(away, below)),
            speed_m_s=np.linalg.norm(fleet.velocity[rows], axis=1),
            battery=np.array(fleet.battery[rows]),
            touched=np.array(fleet.touched[rows]),
        )

    def truth(self, rows: Rows = EVERYONE) -> Kinematics:
        """Return the true state of all n; a copy."""
        fleet = self.fleet
        state = (fleet.position, fleet.velocity, fleet.quaternion, fleet.omega)
        return Kinematics(*(np.array(each[rows]) for each in state))

    def whole_truth(self) -> WholeTruth:
        """Return all that the twin knows, the very arrays that it flies on: to look at only."""
        return WholeTruth(self.fleet, self._places.batch, self._vehicle)

    def fly(self, commands: NDArray[np.float64]) -> None:
        """Fly one decision of every flight that has not ended.

        Args:
            commands: (n, 3) forward, right [m/s], yaw rate [rad/s]: an altitude is held; or
                (n, 4): behind them the downward speed [m/s], NaN where the altitude is held. Or,
                `by_rates`, (n, 4) body rates FRD [rad/s] and thrust 0..1.

        Raises:
            ValueError: Not n commands.
        """
        least = 4 if self.by_rates else 3
        if commands.ndim != 2 or len(commands) != self.n or not least <= commands.shape[1] <= 4:
            accepted = " or ".join(f"({self.n}, {width})" for width in range(least, 5))
            raise ValueError(f"commands of shape {commands.shape}: accepted: {accepted}")
        # NaN: decided when it is sent.
        down = commands[:, 3] if commands.shape[1] == 4 else math.nan
        setpoints = np.insert(commands[:, :3], 2, down, axis=1)
        if self.by_rates:
            setpoints = np.array(commands)
        if self._trace is not None:
            self._trace.deciding(self.fleet)
        began_us = self.fleet.time_us.copy()
        t2_us = self._delays.take(self._decision) + self._extra_us
        if self._companions.remember:
            images = self._further_images()
            self._companions.deciding(self.cameras.image, self.kinematics(), images)
        self._companions.aged(self._timing.fly(self, setpoints, t2_us))
        self._decision += 1
        self._telemetry.step(self._decision, (self.fleet.time_us - began_us) / US_PER_S)
        if self._trace is not None:
            self._trace.decided(
                self.fleet,
                setpoints,
                t2_us,
                self._transport_us + self.cameras.delay_us(self._trace.seen_us),
                self._link_us + later_us(self._uplink, began_us + t2_us),
            )
        sent_us = began_us + TICK_US * ticks_of(t2_us)
        stop_us = None if self._hover_us is None else sent_us + self._hold_us + self._hover_us
        self._companions.decided(setpoints, t2_us, sent_us, stop_us)
        self._look_ahead(self.fleet.verdict == Verdict.FLYING)

    def _look_ahead(self, who: NDArray[np.bool_]) -> None:
        """Let the companions in `who` see what their next decisions will act on."""
        if self._companions.foresee:
            now_us, state = self.fleet.time_us, self.kinematics()
            self._companions.look_ahead(who, self.cameras.image, now_us, state)

    def _held(self) -> Mapping[str, Any]:
        # What a checkpoint of before there were body rates does not have is not in one without.
        unsaved = ("room",) if self.by_rates else ("room", "by_rates")
        held: dict[str, Any] = {
            "navigation": {
                "seeds": self.seeds,
                "zones": self.zones,
                "begun": self._places.begun,
                "decision": self._decision,
                "extra_us": self._extra_us,
            },
            # Its room is looked for anew.
            "fleet": {k: v for k, v in self.fleet._asdict().items() if k not in unsaved},
            "delays": self._delays,
            "telemetry": self._telemetry,
            "cameras": self.cameras,
        }
        # What a checkpoint of an environment without them does not have.
        if not self._winds.calm:
            held["winds"] = self._winds
        if self.by_rates or isinstance(self._timing, PipelinedTiming):
            held["timing"] = self._timing
        held |= self._companions.held()
        return held

    def set_state(self, state: State) -> None:
        """Restore a saved state; arenas are generated again from their seeds.

        Raises:
            UsageError: It is not one of this environment.
        """
        super().set_state(state)
        self._places.restore()
        self.fleet.room[:] = 0.0

    def holding_altitude(self) -> NDArray[np.float64]:
        """Return the downward speeds (n,) [m/s] that hold the altitude."""
        down = self._telemetry.position(self.fleet.position)[:, 2]
        return vertical_speeds(self.spec.episode.altitude_m, down)

    def advance(self, ticks: NDArray[np.int64]) -> None:
        """Advance all flights by ticks (n,); the only place where time passes."""
        to_freeze = self.cameras.ticks_to_freeze(self.fleet.time_us)
        while to_freeze is not None and (to_freeze <= ticks).any():
            part = np.minimum(ticks, to_freeze)
            self._advance(part)
            self.cameras.freeze(self.fleet, self._places.batch, self.seeds)
            ticks = ticks - part
            to_freeze = self.cameras.ticks_to_freeze(self.fleet.time_us)
        self._advance(ticks)

    def advance_in_legs(self, ticks: NDArray[np.int64], setpoints: NDArray[np.float64]) -> bool:
        """Fly all flights in three legs, if they can be; see `timing.Vehicles`."""
        watched = self._trace is not None or self.cameras.may_freeze
        # Between legs only places and attitudes are kept, not how the vehicles move.
        watched |= self.cameras.exposed_in_motion
        if watched or not self._winds.calm or not ticks[:, 0].all():
            return False
        fleet = self.fleet
        # Those that do not fly take both where they are.
        give(fleet, setpoints, fleet.verdict != Verdict.FLYING)
        legs = Legs(
            ticks,
            setpoints,
            fleet.time_us.copy(),
            fleet.position.copy(),
            fleet.quaternion.copy(),
        )
        advance(
            fleet, self._places.batch, ticks.sum(axis=1), self._vehicle, self._rules, None, legs
        )
        seen = fleet._replace(
            time_us=legs.seen_us, position=legs.seen_position, quaternion=legs.seen_quaternion
        )
        everyone = np.ones(self.n, np.bool_)
        self.cameras.capture(seen, self._places.batch, everyone, self.seeds)
        move_all_obstacles(self._places.batch, fleet.time_us)
        return True

    def _advance(self, ticks: NDArray[np.int64]) -> None:
        if not ticks.any():
            return
        if self._trace is not None:
            self._trace.advance(self.fleet, ticks, self._fly)
        else:
            self._fly(ticks)

    def _fly(self, ticks: NDArray[np.int64]) -> None:
        def fly(ticks: NDArray[np.int64], air: NDArray[np.float64] | None) -> None:
            advance(self.fleet, self._places.batch, ticks, self._vehicle, self._rules, air)

        self._winds.fly(self.fleet, ticks, fly)

    def capture(self, who: NDArray[np.bool_]) -> None:
        """Take the frames of those in `who` (n,), from where they are now."""
        if self._trace is not None:
            self._trace.captured(self.fleet, who)
        if (self.fleet.time_us[who] == 0).any():
            self.cameras.freeze(self.fleet, self._places.batch, self.seeds)
        self.cameras.capture(self.fleet, self._places.batch, who, self.seeds)
