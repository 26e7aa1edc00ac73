"""Fault matrix: flights with every fault in every phase and many seeds, and their outcomes."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import TypeAdapter

from airl_mav.core import clock, constants, errors, files, frames, machine
from airl_mav.experiments.executors import ExecutorSettings, Stop, open_executor
from airl_mav.faults import Fault, Phase
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.scenario.aircraft import Aircraft
from firmware_sim.addons.missions.items import NavCommand, PlanFrame
from firmware_sim.autopilot import autopilot_state, commander, flight_modes
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.navigation.plan import MissionType, PlanItem
from firmware_sim.simulation import TOUCHDOWN_M_S, EpisodeSetup, Simulation, builtin_autopilot

End = Literal["not armed", "landed", "crashed", "flying", "flown away", "broken"]
"""Result of a flight.

not armed: arming was rejected; landed: on the ground, motors off, touchdown below the maximum
landing speed; crashed: faster, or upside down; flying: still in the air at the end; flown away:
further from home, or higher, than the bound; broken: NaN or infinity, or an exception.
"""

MATRIX_PHASES: tuple[Phase, ...] = (*("ground", "climb", "hold", "offboard", "mission", "landing"),)

SAFE: frozenset[End] = frozenset({"landed"})

FALLS: frozenset[End] = frozenset({"landed", "crashed"})
"""Results without control: the vehicle falls, within the bounds."""


@dataclass(frozen=True)
class Case:
    """Fault of the matrix."""

    fault: str
    """Fault specification as text, without a time."""
    ends: frozenset[End] = SAFE
    """Allowed results if the fault began in the air."""
    on_ground: frozenset[End] = frozenset({"not armed", "landed"})
    """Allowed results if the fault began on the ground."""

    def allowed(self, phase: Phase) -> frozenset[End]:
        """Return the allowed results for a phase."""
        return self.on_ground | self.ends if phase == "ground" else self.ends


CASES: tuple[Case, ...] = (
    Case("accel off", FALLS),
    Case("accel noise 10x"),
    Case("accel bias 0.5,0.5,0.5m/s2"),
    Case("gyro off", FALLS),
    Case("gyro noise 10x"),
    Case("gyro bias 2,2,2deg/s"),
    Case("gyro delay 8ms"),
    Case("mag off"),
    Case("mag stuck"),
    Case("mag bias 0.1,0.1,0gauss"),
    Case("baro off"),
    Case("baro stuck"),
    Case("baro noise 10x"),
    Case("baro bias 0.5hPa"),
    Case("gps off"),
    Case("gps off for 2s"),
    Case("gps stuck"),
    Case("gps noise 5x"),
    Case("gps bias 20,0,0m"),
    Case("gps drift 0.5,0,0m/s"),
    Case("gps delay 200ms"),
    Case("gps delay 1s", FALLS),
    Case("motor1 off", FALLS),
    Case("motor2 weak 75%"),
    Case("motor2 mismatch 20%"),
    Case("motor2 slow 4x"),
    Case("battery drop 60%"),
    Case("battery drop 92%"),
    Case("battery sag 0.3V"),
    Case("wind gust 6,0,0m/s for 4s"),
    Case("wind step 5,0,0m/s"),
)
"""Faults that PX4 is expected to survive, and faults that no quadrotor survives. Covers the flight
controller alone: camera and link faults belong to the companion."""

STANDS: frozenset[End] = frozenset({"landed", "flying"})
"""Results without a landing detection: safe, but the motors may keep running."""

FITTED_CASES: tuple[Case, ...] = (
    Case("rangefinder off"),
    Case("rangefinder stuck", STANDS, frozenset({"not armed", "landed", "flying"})),
    Case("rangefinder noise 5x"),
    Case("rangefinder bias 0.5m"),
    Case("flow off"),
    Case("flow stuck"),
    Case("flow noise 5x"),
)
"""Faults of optional sensors, flown only on request."""

CASE_OF: Mapping[str, Case] = {case.fault: case for case in (*CASES, *FITTED_CASES)}

AFTER_S = 0.5
"""Time from the start of the phase to the fault [s]."""

ALTITUDE_M = 5.0
FENCE_M = 100.0
"""Distance from home beyond which a flight counts as flown away [m]."""

LONGEST_S = 75.0
OPERATOR_S = 10.0
"""Time from the flight controller's takeover to the operator's command to land [s]."""

_REPEAT_US = 50_000
_LOOK_TICKS = 25
"""Ticks between two checks for non-finite values."""


@dataclass(frozen=True)
class FaultFlight:
    """Result of a flight with a fault."""

    fault: str
    phase: Phase
    seed: int
    end: End
    touchdown_m_s: float | None
    """Maximum contact speed with the floor [m/s]; None = no contact."""
    farthest_m: float
    mode: str
    said: tuple[str, ...]
    """Texts for the operator after the start of the fault."""
    code: str | None = None
    """Identity of the code that flew it (`core.machine.code_of`)."""


def fly_fault(vehicle: VehicleProfile, fault: str, phase: Phase, seed: int) -> FaultFlight:
    """Fly to 5 m, hold, fly north in offboard or mission mode, and land, with a fault on the way.

    The result is deterministic. The simulated pilot ignores unexpected modes, but commands to land
    after `OPERATOR_S`. The compiled plant takes 80 % less time than pybullet.
    """
    words = Fault.model_validate(fault).model_copy(update={"phase": phase, "at_s": AFTER_S})
    setup = EpisodeSetup(vehicle, None, seed, Aircraft(faults=(words,), plant="kernel"))
    autopilot = builtin_autopilot(setup)
    # A vehicle without GPS knows its origin only from the user.
    if (origin := vehicle.told_origin) is not None:
        autopilot.set_origin(origin)
    simulation = Simulation(
        setup, start_us=0, clock=clock.SimClock(), recording=False, autopilot=autopilot
    )
    try:
        return _Flight(simulation, autopilot, fault, phase, seed).fly()
    finally:
        simulation.close()


@dataclass
class _Flight:
    """Simulated pilot of one flight."""

    simulation: Simulation
    autopilot: BuiltinAutopilot
    fault: str
    phase: Phase
    seed: int
    texts: list[str] = field(default_factory=list)
    """Texts for the operator after the start of the fault."""
    streams: bool = False
    """True while the pilot sends offboard setpoints."""
    farthest_m: float = 0.0
    touchdowns: list[float] = field(default_factory=list)
    ticks: int = 0

    def __post_init__(self) -> None:
        """Listen to the autopilot's texts."""
        self.autopilot.on_message = lambda message: self._hear(message.text)

    def _hear(self, text: str) -> None:
        faults = self.simulation.faults
        # Texts before the fault belong to every flight.
        if faults is not None and faults.acted(self.simulation.time_us):
            self.texts.append(text)

    def fly(self) -> FaultFlight:
        simulation = self.simulation
        pilot, end = self._pilot(), None
        while end is None and simulation.time_us < LONGEST_S * constants.US_PER_S:
            try:
                end = next(pilot, None) or self._tick()
            # A numerical failure of the flight controller is a result, not an error of the study.
            except (ArithmeticError, ValueError, IndexError, np.linalg.LinAlgError) as error:
                self.texts.append(f"{type(error).__name__}: {error}")
                end = "broken"
        touchdown_m_s, farthest_m = max(self.touchdowns, default=None), round(self.farthest_m, 3)
        mode, texts = self.autopilot.flight.mode.name, tuple(dict.fromkeys(self.texts))
        result = end or "flying", touchdown_m_s, farthest_m, mode, texts
        return FaultFlight(self.fault, self.phase, self.seed, *result, code=machine.code_now())

    def _tick(self) -> End | None:
        """Fly a tick; return the end if the flight is over, otherwise None."""
        simulation, flight = self.simulation, self.autopilot.flight
        # 20 Hz, as MAVSDK repeats setpoints.
        if self.streams and simulation.time_us % _REPEAT_US < constants.TICK_US:
            self._offer()
        # Read before the tick: a hard touchdown may be detected as landed within it.
        flown = flight.phase is commander.FlightPhase.AIR
        simulation.tick()
        self.ticks += 1
        # Checked rarely, to save time: non-finite values do not disappear again.
        if self.ticks % _LOOK_TICKS == 0 and not (
            np.isfinite(simulation.plant.motion).all()
            and np.isfinite(self.autopilot.estimator.state).all()
        ):
            return "broken"
        distance_m = math.dist((0.0, 0.0, 0.0), simulation.plant.position)
        self.farthest_m = max(self.farthest_m, distance_m)
        # Nothing brings such a vehicle back within the time limit.
        if distance_m > FENCE_M:
            return "flown away"
        for hit in simulation.plant.collisions:  # collisions of this tick only: nothing is recorded
            self.touchdowns.append(hit.speed_m_s)
            # Harder contacts of a vehicle in the air are crashes; on the ground a tipped rotor
            # touches, too.
            if hit.speed_m_s >= TOUCHDOWN_M_S and flown:
                return "crashed"
        return None

    def _offer(self) -> None:
        """Send an offboard setpoint to the north."""
        north = np.array([2.0, 0.0, 0.0])
        setpoint = autopilot_state.Setpoint(np.full(3, math.nan), north, 0.0, math.nan)
        self.autopilot.offer_setpoint(setpoint, self.simulation.time_us)

    def _waypoint(self) -> PlanItem:
        """Return a mission item north of any position that is reached."""
        origin = self.autopilot.estimator.origin
        if origin is None:
            raise ValueError("a mission without a position")
        place = frames.local_to_geodetic(np.array([FENCE_M, 0.0, 0.0]), origin)
        return PlanItem(
            NavCommand.WAYPOINT,
            PlanFrame.GLOBAL_RELATIVE_ALT_INT,
            (0.0, 0.0, 0.0, math.nan),
            place.latitude_deg,
            place.longitude_deg,
            ALTITUDE_M,
        )

    def _pilot(self) -> Iterator[End | None]:
        """Act as the pilot, one tick per step; yield the end when it is known."""
        autopilot = self.autopilot
        # A fault on the ground may prevent the estimator's start.
        while autopilot.flight.phase is commander.FlightPhase.BOOT:
            if self.simulation.time_us > 20 * constants.US_PER_S:
                yield "not armed"
            yield None
        yield from self._wait(2.0)
        # Checks such as a stable heading need some seconds: a pilot tries again.
        for _ in range(5):
            if autopilot.arm(force=False) is autopilot_state.Result.ACCEPTED:
                break
            yield from self._wait(1.0)
        else:
            yield "not armed"
        autopilot.takeoff(ALTITUDE_M)
        yield from self._fly_as(flight_modes.Mode.TAKEOFF, 30.0, until=flight_modes.Mode.HOLD)
        yield from self._fly_as(flight_modes.Mode.HOLD, 2.0)
        north = flight_modes.Mode.MISSION if self.phase == "mission" else flight_modes.Mode.OFFBOARD
        # After a failsafe the flight controller keeps the vehicle.
        if autopilot.flight.mode is flight_modes.Mode.HOLD:
            if north is flight_modes.Mode.MISSION:
                autopilot.plans.store(MissionType.MISSION, (self._waypoint(),), 1, 0)
            else:
                self.streams = True
                self._offer()
                yield None
            autopilot.set_mode(north)
        yield from self._fly_as(north, 3.0)
        self.streams = False
        if autopilot.flight.mode is north:
            autopilot.set_mode(flight_modes.Mode.LAND)
        else:
            # A failsafe has taken over: the pilot watches, then commands a landing.
            yield from self._until_down(OPERATOR_S)
            autopilot.set_mode(flight_modes.Mode.LAND)
        yield from self._until_down(LONGEST_S)

    def _fly_as(
        self, mode: flight_modes.Mode, limit_s: float, until: flight_modes.Mode | None = None
    ) -> Iterator[End | None]:
        """Wait while a mode is active, at most `limit_s` [s]."""
        end_us = self.simulation.time_us + limit_s * constants.US_PER_S
        flight = self.autopilot
        while flight.flight.mode is mode and self.simulation.time_us < end_us:
            if flight.flight.phase < commander.FlightPhase.GROUND:
                yield "landed"
            yield None
        if until is not None and flight.flight.mode is mode:
            flight.set_mode(until)

    def _until_down(self, limit_s: float) -> Iterator[End | None]:
        """Wait until the motors are off, at most `limit_s` [s]."""
        end_us = self.simulation.time_us + limit_s * constants.US_PER_S
        while self.simulation.time_us < end_us:
            if self.autopilot.flight.phase < commander.FlightPhase.GROUND:
                # Motors off above the ground: the vehicle falls.
                yield "landed" if self.simulation.plant.position[2] > -0.5 else "crashed"
            yield None

    def _wait(self, seconds: float) -> Iterator[None]:
        for _ in range(round(seconds * constants.US_PER_S / constants.TICK_US)):
            yield None


SCHEMA = 2

ANY: frozenset[End] = frozenset({"not armed", "landed", "crashed"})
"""Accepted ends of a flight with a fault outside of the catalogue."""


@dataclass(frozen=True)
class MatrixCell:
    """All flights with one fault in one phase."""

    fault: str
    phase: Phase
    flights: tuple[FaultFlight, ...]

    @property
    def ends(self) -> Mapping[End, int]:
        """Number of flights by end, the most frequent end first."""
        return dict(Counter(flight.end for flight in self.flights).most_common())

    @property
    def unexpected(self) -> tuple[FaultFlight, ...]:
        """Flights with an undocumented end."""
        case = CASE_OF.get(self.fault, Case(self.fault, ANY))
        allowed = case.allowed(self.phase)
        return tuple(flight for flight in self.flights if flight.end not in allowed)

    @property
    def touchdown_m_s(self) -> float | None:
        """Maximum touchdown speed of the landed flights [m/s]; None = no contact."""
        speeds = [f.touchdown_m_s for f in self.flights if f.end == "landed"]
        return max((speed for speed in speeds if speed is not None), default=None)


def fly_matrix(
    vehicle: VehicleProfile,
    faults: Sequence[str],
    phases: Sequence[Phase] = MATRIX_PHASES,
    seeds: Sequence[int] = (1,),
    *,
    workers: int = 1,
    known: Sequence[MatrixCell] = (),
    flown: Callable[[MatrixCell], None] = lambda _: None,
) -> list[MatrixCell]:
    """Fly every fault in every phase, except for `known` cells with equal seeds; deterministic."""
    kept = {
        (cell.fault, cell.phase): cell
        for cell in known
        if [flight.seed for flight in cell.flights] == list(seeds)
    }
    jobs = [(fault, phase) for fault in faults for phase in phases]
    missing = [job for job in jobs if job not in kept]
    cells: list[MatrixCell] = []
    fly = partial(_fly_cells, vehicle, tuple(seeds))
    with (
        open_executor(ExecutorSettings(workers=workers), in_process=True) as executor,
        closing(executor.run(missing, fly, name=" ".join)) as new,
    ):
        for job in jobs:
            while job not in kept:  # Workers finish in any order.
                done, cell = next(new)
                kept[done] = cell
            cells.append(kept[job])
            flown(cells[-1])
    return cells


def _fly_cells(
    vehicle: VehicleProfile,
    seeds: Sequence[int],
    stop: Stop,  # noqa: ARG001 (a worker is killed)
) -> Callable[[tuple[str, Phase]], list[MatrixCell]]:
    """Return the function of a worker that flies a cell."""
    return lambda job: [MatrixCell(*job, tuple(fly_fault(vehicle, *job, s) for s in seeds))]


def markdown(cells: Sequence[MatrixCell]) -> str:
    """Return the matrix as a table with a row per fault; `!` marks undocumented ends."""
    phases = list(dict.fromkeys(cell.phase for cell in cells))
    by_key = {(cell.fault, cell.phase): cell for cell in cells}
    lines = [f"| fault | {' | '.join(phases)} |", f"|---|{'---|' * len(phases)}"]
    for fault in dict.fromkeys(cell.fault for cell in cells):
        row = [cell_text(by_key[fault, phase]) for phase in phases]
        lines.append(f"| `{fault}` | {' | '.join(row)} |")
    return "\n".join(lines) + "\n"


def cell_text(cell: MatrixCell) -> str:
    """Return the ends of a cell's flights: "19 landed (0.8 m/s), 1 crashed !"."""
    parts = []
    for end, count in cell.ends.items():
        speed = cell.touchdown_m_s if end == "landed" else None
        told = "" if speed is None else f" ({speed:.1f} m/s)"
        parts.append(f"{count} {end}{told}")
    return ", ".join(parts) + (" !" if cell.unexpected else "")


class Matrix(NamedTuple):
    """Content of `faults.json`."""

    made: dict[str, Any]
    """Software and machine of the flights (`core.provenance`)."""
    vehicle: str
    """SHA-256 of the vehicle profile."""
    cells: tuple[MatrixCell, ...]


_FLIGHTS = TypeAdapter(tuple[FaultFlight, ...])


def with_cells(matrix: Matrix, cells: Sequence[MatrixCell]) -> Matrix:
    """Return a matrix with its cells of equal fault and phase replaced by these cells."""
    new = {(cell.fault, cell.phase) for cell in cells}
    kept = (cell for cell in matrix.cells if (cell.fault, cell.phase) not in new)
    return matrix._replace(cells=(*cells, *kept))


def vehicle_digest(vehicle: VehicleProfile) -> str:
    """Return the SHA-256 of a profile."""
    return hashlib.sha256(vehicle.model_dump_json().encode()).hexdigest()


def save(matrix: Matrix, path: Path) -> None:
    """Write every flight of a matrix as JSON, atomically."""
    flights = [asdict(flight) for cell in matrix.cells for flight in cell.flights]
    head = {"schema": SCHEMA, "made": matrix.made, "vehicle": matrix.vehicle}
    files.write_json(path, {**head, "flights": flights})


def load(path: Path) -> Matrix:
    """Read a matrix. Raises UsageError if it is missing or damaged."""
    data = files.read_json(path, SCHEMA, "fault matrix")
    try:
        flights = _FLIGHTS.validate_python(data["flights"])
        made, vehicle = dict(data["made"]), str(data["vehicle"])
    except (KeyError, TypeError, ValueError):
        raise errors.UsageError(
            f"{path}: no fault matrix of this version; accepted: faults.json"
        ) from None
    cells: dict[tuple[str, Phase], list[FaultFlight]] = {}
    for flight in flights:
        cells.setdefault((flight.fault, flight.phase), []).append(flight)
    return Matrix(made, vehicle, tuple(MatrixCell(*key, tuple(of)) for key, of in cells.items()))


def resumed(
    path: Path,
    made: Mapping[str, Any],
    vehicle: str,
    *,
    mixed: bool,
    say: Callable[[str], None] = lambda _: None,
) -> Matrix:
    """Return a stopped run's matrix, or an empty one.

    Raises UsageError for another vehicle's matrix, and for other code unless `mixed`.
    """
    if not path.exists():
        return Matrix(dict(made), vehicle, ())
    found = load(path)
    if found.vehicle != vehicle:
        raise errors.UsageError(f"{path}: flown by another vehicle; accepted: another --out")
    flown = [flight.code for cell in found.cells for flight in cell.flights]
    machine.check_code(path, found.made, flown, mixed=mixed, say=say)
    return found
