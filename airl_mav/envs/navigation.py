"""N flights at a time: the companion's decision loop around the vectorized simulator.

Decisions follow `companion.pilot`: the frame is older than the state, and the previous setpoint
remains active during inference and until the new setpoint arrives. The hold starts when the
setpoint is sent, so a decision takes t2 plus the hold, without the link. All times are ticks of
simulated time, so results are independent of the machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.constants import TICK_US, US_PER_MS, US_PER_S, CommandKind
from airl_mav.core.errors import FieldError, UsageError
from airl_mav.core.streams import Stream, stream
from airl_mav.envs.arena_batch import ArenaBatch, move_all_obstacles
from airl_mav.envs.cameras import Cameras
from airl_mav.envs.companions import Companions
from airl_mav.envs.decision import Timing, begin_decision, new_decision
from airl_mav.envs.draws import BLOCK, DelayDraws, TelemetryErrors, Winds
from airl_mav.envs.episode_arenas import EpisodeArenas
from airl_mav.envs.faults import delays_of, gym_faults, later_us
from airl_mav.envs.fleet import (
    STILL,
    Fleet,
    FleetConstants,
    FlightArrays,
    FlightStatus,
    FramePoses,
    Rules,
    hover,
    new_fleet,
    put_vehicle,
    vehicle_of,
)
from airl_mav.envs.fleet_step import fly
from airl_mav.envs.observations import COMPILED, EncodedBody, check_conditions, sight_of
from airl_mav.envs.saved_state import State, Stateful
from airl_mav.envs.spec import SHIPPED_REWARDS, EnvironmentSpec
from airl_mav.envs.stopping import injections_of
from airl_mav.envs.world import World, decide, status
from airl_mav.faults import Fault, check_gym
from airl_mav.latency.injection import Injection
from airl_mav.policy.actions import UPRIGHT_S
from airl_mav.policy.images import Bytes, body_bytes
from airl_mav.policy.layouts import GOAL, VELOCITY, Encoded, encode_layout, layout_of
from airl_mav.policy.observation import Kinematics, Observation, Rows, observe
from airl_mav.policy.observation_spec import ObservationSpec
from airl_mav.prediction import Compensator
from airl_mav.profiles import camera, loading, projections
from airl_mav.profiles.arena import OBSTACLES, ArenaSpec
from airl_mav.profiles.vehicle import Payload, VehicleProfile, check_spread, equipped
from airl_mav.vehicle.airframe import draw_airframe, spreads

if TYPE_CHECKING:
    from airl_mav.envs.evaluation import Trace

EVERYONE = slice(None)
"""Rows of all n vehicles."""


class CommandType(NamedTuple):
    """Kind of commands."""

    least: int
    """Minimum number of columns of commands."""
    setpoint: tuple[int, ...]
    """Columns of `Fleet.setpoint` with these numbers."""
    expire: bool
    """True if a command that is not replaced in time ends in a stop."""


COMMANDS: dict[CommandKind, CommandType] = {
    "velocity": CommandType(3, (0, 1, 3), expire=False),
    "body_rates": CommandType(4, (0, 1, 2, 3), expire=True),
}
"""Kinds of commands of the vectorized simulator."""


class WholeTruth(NamedTuple):
    """True state, hidden from policies, for experts in imitation learning."""

    fleet: Fleet
    arenas: ArenaBatch
    vehicle: FleetConstants


class Navigation(Stateful):
    """N vehicles, each flying to its goal. Slots do not reset automatically."""

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
            vehicle: Loaded vehicle with payload and computer; None = vehicle of `spec` with the
                computer of `spec.delay`.
            arena: Loaded arena; None = arena of `spec`.
            injection: Source of t2; None = `spec.delay`.
            latency_draw: Number of the latency realization; another number gives other draws.
            arena_seed: Seed of arena and goal of all episodes; None = the episode's seed.
            trace: Recorder of the flights; None = no recording. Does not affect results.
            computer_w: Power of the onboard computer of `vehicle` from the pack [W].
            battery_charge: State of charge at the start of every flight, 1 full to 0 empty.
            compensator: Latency compensator of n companions; None = created if `spec` compensates.
            faults: Faults of every flight, as supported at level gym (`envs.faults`); not part of a
                saved state.
            commands: Command type of `fly`, velocity or body_rates; None = as in the actions of
                `spec`.

        Raises:
            UsageError: A profile is unusable, the camera does not match the layout, or level gym
                does not support a fault.
        """
        self.spec = spec
        self.n = n
        self.commands = COMMANDS[commands or spec.action_spec.commands]
        """Kind of the commands of `fly`."""
        if vehicle is None:
            vehicle, computer = equipped(spec.vehicle, spec.delay.computer, Payload())
            computer_w = computer.onboard_watts
        self.vehicle: VehicleProfile = vehicle
        self.arena_spec: ArenaSpec = arena or loading.load_profile("arenas", spec.arena, ArenaSpec)
        sight = sight_of(spec, self.vehicle)
        self.camera: camera.Camera = sight.camera
        self.observation: ObservationSpec = sight.observation
        self._image_shape = self.observation.image_shape
        self.intrinsics: Intrinsics = sight.intrinsics
        known = self.arena_spec.generator == OBSTACLES
        if spec.goal_height and known and self.arena_spec.goal.height_m is None:
            accepted = f"false in arena {spec.arena!r}, whose profile has no goal.height_m"
            raise FieldError("goal_height", True, accepted)
        self.injections = injections_of(spec.delay) if injection is None else (injection,)
        self._trace = trace
        parameters = self.vehicle.flown_parameters()
        self._vehicle = vehicle_of(self.vehicle, parameters.__getitem__, computer_w)
        self._charge = battery_charge
        rules = spec.episode
        self._rules = Rules(rules.goal_radius_m, round(rules.time_limit_s * US_PER_S))
        self._transport_us = round(spec.delay.transport_ms * US_PER_MS)
        self._link_us = round(spec.delay.link_ms * US_PER_MS)
        width_m, looks = self.vehicle.body.width_m, sight.coloured
        self.places = EpisodeArenas(spec, self.arena_spec, n, width_m, arena_seed, looks=looks)
        """Arenas of the flights; `prepare` generates likely next ones ahead."""
        self.stages, self.arenas = self.places.stages, self.places.present
        self.seeds, self.zones = self.places.seeds, self.places.zones
        self.fleet, self._calm_start = new_fleet(n), new_fleet(1)
        # The calm start is the same for all seeds, so it is computed once.
        hover(self._calm_start, 0, rules.altitude_m, self._vehicle, battery=battery_charge)
        self._number = np.zeros(n, np.int64)
        """(n,) number of the present decision in each episode, from 0."""
        self._before_draw = 0
        """Number of decisions before the next draw."""
        self._extra_us = np.zeros(n, np.int64)
        self._delays = DelayDraws(
            n, self.injections, round(spec.delay.native_ms * US_PER_MS), draw=latency_draw
        )
        randomisation = spec.randomisation
        check_spread(self.vehicle, randomisation, "randomisation")
        check_conditions(sight, spec, faults)
        table = self.vehicle.estimation if randomisation.estimation else None
        self._telemetry = TelemetryErrors(n, table, randomisation.navigation_noise)
        pipelined = spec.decisions == "pipelined"
        check_gym(faults, pipelined=pipelined)
        self._winds = Winds(n, spec.wind, faults)
        seen = (self.places.looks, self.places.meshes, sight.further)
        self.cameras = Cameras(n, self.camera, self._transport_us, randomisation, faults, *seen)
        self._uplink = gym_faults(faults, "uplink")
        self._decision = new_decision(self._times(pipelined=pipelined), self._telemetry.errors)
        self._stops = trace is not None or self._winds.gusty or self.cameras.may_freeze
        """True if decisions may need Python before their end."""
        own = spec.reward not in SHIPPED_REWARDS
        self._reward = -1 if own else SHIPPED_REWARDS.index(spec.reward)
        self._world: World | None = None
        self._status: FlightArrays | None = None
        self.paid = np.zeros(n)
        """(n,) rewards of the last decisions if `spec` names a built-in reward."""
        self.ending = np.zeros(n, np.int64)
        """(n,) end of flight in the last decisions: `world.GOES_ON` or another value."""
        self._encoded: Encoded | None = None
        """Encoded present observations, if computed but not yet returned."""
        if compensator is None and spec.compensate:
            compensator = Compensator(n, self.vehicle, self.intrinsics)
        self._companions = Companions(
            n,
            self.intrinsics,
            compensator=compensator,
            in_flight=bool(spec.in_flight),
            earlier=spec.frames - 1,
            further={
                name: (lens, spec.cameras[name].frames - 1) for name, lens in sight.lenses.items()
            },
        )
        self._drift = self._telemetry.drift()
        self._renders = self.cameras.eye is not None
        """True if kernels capture the frames; otherwise Python does."""
        self._encoding = self._encoding_of(spec) if self._renders else None

    def _times(self, *, pipelined: bool) -> Timing:
        """Return the timing of decisions.

        Raises:
            UsageError: The hold is too short: a decision would have to wait for its frame.
        """
        rules, cameras = self.spec.episode, self.cameras
        hold_us = round(rules.hold_s * US_PER_S)
        late_us = round(sum(each.fault.amount for each in self._uplink) * US_PER_S)
        # The newest frame at the next observation must be captured after the setpoint's arrival.
        least_us = self._link_us + late_us + cameras.latest_us + cameras.times.period_us
        if not pipelined and hold_us < least_us:
            raise UsageError(
                f"episode.hold_s = {rules.hold_s:g}: accepted: value >= {least_us / 1e6:g} s "
                f"(delay.link_ms, delay.transport_ms and {cameras.times.period_us / 1e3:g} ms"
                " between two frames, and what faults delay)"
            )
        # Negative: velocity setpoints do not time out.
        timeout_us = -TICK_US
        if self.commands.expire:
            held_s = 0.0 if pipelined else rules.hold_s
            timeout_us = round((rules.decision_timeout_s or held_s + UPRIGHT_S) * US_PER_S)
        return Timing(
            pipelined=pipelined,
            link_us=self._link_us,
            hold_us=hold_us,
            hover_us=-1 if rules.hover_after_s is None else round(rules.hover_after_s * US_PER_S),
            timeout=round(timeout_us / TICK_US),
            altitude_m=rules.altitude_m,
            uplink=delays_of(self._uplink),
            frames=cameras.times,
        )

    def _encoding_of(self, spec: EnvironmentSpec) -> Bytes | None:
        """Return the constants for encoding in kernels; None for encoding in Python."""
        # The compiled encoding supports the plain layout only.
        if spec.layout != "body" or spec.frames > 1 or spec.in_flight or spec.goal_height:
            return None
        return None if self._companions.foresee else body_bytes(self.camera.range_m)

    def begin(self, slots: Sequence[int], seeds: Sequence[int], zone: int | None = None) -> None:
        """Start episodes: each hovers above its start, with the first frame taken.

        Args:
            slots: Indices of the vehicles.
            seeds: Seeds of the episodes, one per slot.
            zone: Curriculum zone, or stage, that bounds the goals; None = the whole arena.

        Raises:
            UsageError: Arena generation failed for a seed, or the zone is out of range.
        """
        self.places.check_zone(zone)
        who = np.zeros(self.n, np.bool_)
        for i, seed in zip(slots, seeds, strict=True):
            self._begin(i, int(seed), zone)
            who[i] = True
        self._before_draw, self._world, self._status = 0, None, None
        self._encoded = None
        # The first frame shows the vehicle at its start.
        for array, theirs in zip(self._decision.seen, self._moving(), strict=True):
            array[who] = theirs[who]
        self._take_frames(who)
        self._look_ahead(who)

    def _begin(self, i: int, seed: int, zone: int | None) -> None:
        self.places.begin(i, seed, zone)
        randomisation = self.spec.randomisation
        airframe = None
        if spreads(randomisation):
            # Every random part has its own stream, so one setting does not change other draws.
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
        self._number[i] = 0
        low, high = randomisation.extra_delay_ms
        extra_ms = low if low == high else stream(seed, Stream.DELAY).uniform(low, high)
        self._extra_us[i] = round(extra_ms * US_PER_MS)
        self._delays.begin(i, seed)
        self._telemetry.begin(i, seed)
        self.cameras.begin(i, seed)
        begin_decision(self._decision, i)
        self._companions.begin(i)

    def see(self, slots: Sequence[int] | None = None) -> Observation:
        """Return the present observations of all vehicles, or of vehicles in `slots`.

        With a leading axis (n,). With latency compensation, observations are predicted for the time
        at which the decision is expected to act.
        """
        rows, known = EVERYONE if slots is None else slots, self._companions
        if known.foresee:
            image, state = known.foreseen(rows)
        else:
            image, state = self.cameras.image[rows], self.kinematics(rows)
        goal = self.places.batch.goal[rows]
        # Goals without a height have two coordinates.
        if np.isnan(goal[:, 2]).all():
            goal = goal[:, :2]
        eyes = self.cameras.further
        lenses = {name: each.intrinsics for name, each in eyes.items()}
        views = known.views(self._further_images(), lenses, rows)
        return observe(
            *(image, self.intrinsics, state, goal, known.in_flight(rows), known.earlier(rows)),
            views,
        )

    def _further_images(self) -> dict[str, NDArray[Any]]:
        return {name: each.image for name, each in self.cameras.further.items()}

    def observe(self, slots: Sequence[int] | None = None) -> Encoded:
        """Return the present observations in the environment's layout.

        For all vehicles, or for vehicles in `slots`.
        """
        # The kernels have already encoded these observations; they are valid once.
        encoded, self._encoded = self._encoded, None
        if encoded is not None and slots is None:
            return encoded
        if layout_of(self.observation.layout).remembers:
            layout = self.observation.layout
            raise FieldError("layout", layout, "body, paper, scan or your own, without a memory")
        return encode_layout(self.observation, self.see(slots), COMPILED)

    def kinematics(self, rows: Rows = EVERYONE) -> Kinematics:
        """Return the states as reported by telemetry, with the estimator's error."""
        return self._telemetry.report(self.truth(rows), rows)

    def flights(self) -> FlightArrays:
        """Return the status of all flights; it is never modified."""
        if self._status is None:
            numbers, whole = self._room_for_status()
            status(self.fleet, self.places.batch.goal, numbers, whole)
            self._status = FlightArrays(*whole[:2], *numbers[:-1])
        return self._status

    def truth(self, rows: Rows = EVERYONE) -> Kinematics:
        """Return a copy of the true states."""
        fleet = self.fleet
        position, velocity = fleet.position[rows].copy(), fleet.velocity[rows].copy()
        return Kinematics(
            position, velocity, fleet.quaternion[rows].copy(), fleet.omega[rows].copy()
        )

    def whole_truth(self) -> WholeTruth:
        """Return the simulator's complete state: live arrays, read-only by convention."""
        if self.places.begun.any():  # Before the first episode there is no arena.
            move_all_obstacles(self.places.batch, self.fleet.time_us)
        return WholeTruth(self.fleet, self.places.batch, self._vehicle)

    def fly(self, commands: NDArray[np.float64], *, encode: bool = False) -> None:
        """Fly one decision of every flight that has not ended.

        Args:
            commands: (n, 3) forward, right [m/s], yaw rate [rad/s] with altitude hold; or (n, 4)
                with an additional downward speed [m/s], NaN = altitude hold. Of the kind body_rates
                (n, 4) body rates FRD [rad/s] and thrust 0..1.
            encode: True if `observe` is called next.

        Raises:
            ValueError: Wrong number or width of commands.
        """
        least = self.commands.least
        if commands.ndim != 2 or len(commands) != self.n or not least <= commands.shape[1] <= 4:
            accepted = " or ".join(f"({self.n}, {width})" for width in range(least, 5))
            raise ValueError(f"commands of shape {commands.shape}: accepted: {accepted}")
        # Trace and companions need the state before the decision's flight.
        if self._trace is not None:
            self._trace.deciding(self.fleet, self._decision.seen.time_us)
        if self._companions.remember:
            images = self._further_images()
            self._companions.deciding(self.cameras.image, self.kinematics(), images)
        self._draw()
        world = self._world or self._made_world()
        image = self._image_shape if encode and self._encoding else (0, 0)
        rows = self.n if image[0] else 0
        seen = EncodedBody(
            np.empty((rows, *image), np.uint8),
            np.empty((rows, 3), np.float32),
            np.empty((rows, 3), np.float32),
        )
        self._fly(world, commands, seen)
        if rows:
            self._encoded = {"depth": seen.depth[:, None], VELOCITY: seen.velocity, GOAL: seen.goal}
        self._tell()

    def _fly(self, world: World, commands: NDArray[np.float64], seen: EncodedBody) -> None:
        """Fly a decision, with pauses for Python."""
        numbers, whole = self._room_for_status()
        waiting, resumed = self.n, False
        # The kernels return early where Python must draw wind, freeze an image or record.
        while waiting > 0:
            if self._stops:
                self._winds.blow(self.fleet)
                self._decision.pause_us[:] = self._next_stop_us()
            waiting = decide(world, commands, resumed, numbers, whole, seen)
            if self._stops:
                self.cameras.freeze(self.fleet, self.places.batch, self.seeds)
                if self._trace is not None:
                    self._trace.sample(self.fleet)
            resumed = True
        self._status = FlightArrays(*whole[:2], *numbers[:-1])
        self.paid, self.ending = numbers[-1], whole[2]
        if not self._renders:
            self._take_frames(np.ones(self.n, np.bool_))

    def _next_stop_us(self) -> NDArray[np.int64]:
        """Return the time of the next pause for Python (n,) [µs]."""
        limits = [self._winds.ends_us(), self.cameras.next_freeze_us(self.fleet.time_us)]
        if self._trace is not None:
            limits.append(self._trace.next_us(self.fleet))
        soonest: NDArray[np.int64] = np.minimum.reduce(
            [each for each in limits if each is not None]
        )
        return soonest

    def _tell(self) -> None:
        """Record the completed decisions in the trace and the companions."""
        decision = self._decision
        began_us, t2_us = decision.began_us, decision.t2_us
        if self._trace is not None:
            self._trace.decided(
                self.fleet,
                decision.setpoint,
                t2_us,
                self._transport_us + self.cameras.delay_us(self._trace.seen_us),
                self._link_us + later_us(self._uplink, began_us + t2_us),
            )
        if self._companions.account:
            self._companions.aged(TICK_US * decision.age)
            # Sent at a whole tick, as in the kernels.
            sent_us = began_us + TICK_US * ((t2_us + TICK_US // 2) // TICK_US)
            stop_us = None
            if self._decision.timing.hover_us >= 0:
                stop_us = sent_us + self._decision.timing.hold_us + self._decision.timing.hover_us
            self._companions.decided(decision.setpoint.copy(), t2_us.copy(), sent_us, stop_us)
            self._look_ahead(self.fleet.verdict == FlightStatus.FLYING)

    def _draw(self) -> None:
        """Draw the next block of latencies and errors where it is due."""
        if self._before_draw > 0:
            self._before_draw -= 1
            return
        self._delays.draw(self._number)
        # The errors of decision n + 1 are drawn ahead: `step_error` uses them at its end.
        self._telemetry.draw(self._number + 1)
        then = self._number + 1
        # Decisions until the nearest end of any block; until then nothing is due.
        self._before_draw = int(np.minimum(-then % BLOCK, -(then + 1) % BLOCK).min())

    def _room_for_status(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        return np.empty((len(FlightArrays._fields) - 1, self.n)), np.empty((3, self.n), np.int64)

    def _moving(self) -> FramePoses:
        """Return time and motion of the vehicles."""
        fleet = self.fleet
        return FramePoses(
            fleet.time_us, fleet.position, fleet.quaternion, fleet.velocity, fleet.omega
        )

    def _made_world(self) -> World:
        """Return the kernels' arguments, rebuilt after changes of arenas or meshes."""
        eye = self.cameras.eye
        self._world = World(
            *(self.fleet, self.places.batch, self._vehicle, self._rules, self._decision),
            *(self._delays.block, self._extra_us, self._number, self._winds.air, self._drift),
            *(eye, self._encoding, self._reward, self.spec.episode.hold_s),
        )
        return self._world

    def compile_dynamics(self) -> None:
        """Compile or load the flight kernels; no vehicle moves."""
        fly(
            *(self.fleet, self.places.batch, np.zeros(self.n, np.int64), self._vehicle),
            *(self._rules, self._winds.air, self._decision),
        )

    def _look_ahead(self, who: NDArray[np.bool_]) -> None:
        """Predict observations for the next decisions of the companions in `who`."""
        if self._companions.foresee:
            now_us, state = self.fleet.time_us, self.kinematics()
            self._companions.look_ahead(who, self.cameras.image, now_us, state)

    def _held(self) -> Mapping[str, Any]:
        # Keeps velocity checkpoints compatible with versions before body rates.
        unsaved = ("room",) if self.commands.expire else ("room", "by_rates")
        held: dict[str, Any] = {
            "navigation": {
                "seeds": self.seeds,
                "zones": self.zones,
                "begun": self.places.begun,
                "decision": self._number,
                "extra_us": self._extra_us,
            },
            # `room` is recomputed.
            "fleet": {k: v for k, v in self.fleet._asdict().items() if k not in unsaved},
            "delays": self._delays,
            "telemetry": self._telemetry,
            "cameras": self.cameras,
        }
        # Optional parts are only saved if used, as in earlier checkpoints.
        if not self._winds.calm:
            held["winds"] = self._winds
        decision = self._decision
        timing: dict[str, Any] = {}
        if self._decision.timing.pipelined:
            timing = {"left": decision.left, "in_flight": decision.in_flight}
        if self.commands.expire:
            rates = (decision.newest, decision.wanted, decision.sent_us)
            timing["rates"] = dict(zip(("newest", "wanted", "sent_us"), rates, strict=True))
        if timing:
            held["timing"] = timing
        held |= self._companions.held()
        return held

    def set_state(self, state: State) -> None:
        """Restore a saved state; arenas are regenerated from their seeds.

        Raises:
            UsageError: The state is from another environment.
        """
        super().set_state(state)
        self.places.restore()
        # 0 forces a contact check in the next tick.
        self.fleet.room[:] = 0.0
        self._before_draw, self._world, self._status = 0, None, None
        self._encoded = None

    def _take_frames(self, who: NDArray[np.bool_]) -> None:
        """Capture the frames of vehicles in `who` (n,) at their poses when the frames were due."""
        seen, arenas = self._decision.seen, self.places.batch
        if self.cameras.may_freeze and (seen.time_us[who] == 0).any():
            self.cameras.freeze(self.fleet, arenas, self.seeds)
        self.cameras.capture(seen, arenas, who, self.seeds)


def compile_vectorized(kind: projections.CameraKind) -> None:
    """Compile all kernels by a flight of a few decisions."""
    flying = _navigation(kind)
    flying.begin([0], [1])
    # A few decisions reach every kernel of a flight.
    for _ in range(3):
        flying.observe()
        flying.fly(np.zeros((1, 3)))


def compile_dynamics() -> None:
    """Compile flight dynamics and contacts."""
    _navigation("depth").compile_dynamics()


def compile_images(kind: projections.CameraKind) -> None:
    """Compile arenas and images."""
    _navigation(kind).begin([0], [1])


def _navigation(kind: projections.CameraKind) -> Navigation:
    return Navigation(EnvironmentSpec.model_validate({"camera": {"kind": kind}}), 1)
