"""`airl vehicle`: static figures and step responses of an aircraft."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import POSITIONAL
from airl_mav.core import errors, fields, progress
from airl_mav.core.constants import G_PER_KG, GRAVITY_M_S2, TICK_S
from airl_mav.core.files import read_limited
from airl_mav.envs import fleet, fleet_step, stopping
from airl_mav.profiles.loading import MOST_BYTES
from airl_mav.profiles.vehicle import CORNERS, Payload, VehicleProfile, equipped
from airl_mav.report import document
from airl_mav.vehicle.airframe import Airframe, command_for, steady_speed
from airl_mav.vehicle.power import PowerModel, level_powers_w, standing_power_w

THROTTLES = tuple(i / 10.0 for i in range(1, 11))
"""Commands of the motor table."""

STEP_S = 6.0
SAMPLE_TICKS = 2
SETTLED = 0.05
"""Half width of the band that ends the settling time, as a share of the step."""

STEPS = {
    "velocity north, 3 m/s": (0, 3.0),
    "climb, 1 m/s": (2, -1.0),
    "yaw rate, 45 deg/s": (3, float(np.deg2rad(45.0))),
}
"""Steps from a hover: column and value of the setpoint (forward, right, down, yaw rate)."""

TOP_SPEED_S = 30.0
HOVER_TOLERANCE = 0.1
"""Accepted relative deviation of MPC_THR_HOVER: PX4's hover thrust estimator starts from it."""

MIN_THRUST_TO_WEIGHT = 1.8
"""Ratio below which wind and manoeuvres saturate the motors; PX4's documentation advises 2."""

BENCH_RANGES = {"throttle_percent": (0.0, 100.0), "thrust_g": (0.0, 1e5), "voltage_v": (1.0, 1e3)}
"""Ranges of a bench table's columns; all others 0 to 1000."""


@dataclass(frozen=True)
class StepFigures:
    """Response of the built-in flight controller to a setpoint step from a hover."""

    rise_s: float | None
    """Time from 10 to 90 % [s]; None = not reached."""
    overshoot_percent: float
    settle_s: float | None
    """Time after which the response stays within 5 % [s]; None = not settled."""


@dataclass(frozen=True)
class MotorPoint:
    """Operating point of all motors in a static test on a full pack."""

    throttle: float
    thrust_n: float
    """Thrust of one motor [N]."""
    current_a: float
    """Current of the pack without the onboard computer [A]."""
    power_w: float


@dataclass(frozen=True)
class BenchFit:
    """Constants of a vehicle profile fitted to a bench table of one motor."""

    thrust_max_n: float
    thrust_curve: float
    drive_efficiency: float
    figure_of_merit: float
    """Value of the profile: a bench table identifies only its product with `drive_efficiency`."""
    throttle: NDArray[Any]
    """Commands (n,), 0..1."""
    measured: NDArray[Any]
    """Thrust [N] and current [A], (n, 2); the same for `model`."""
    model: NDArray[Any]


@dataclass(frozen=True)
class AirframeFigures:
    """Figures of a vehicle with its onboard computer."""

    mass_kg: float
    thrust_to_weight: float
    hover_throttle: float
    """Motor command in a hover, 0..1; MPC_THR_HOVER of the built-in flight controller."""
    hover_thrust_share: float
    """Share of maximum thrust in a hover; MPC_THR_HOVER of PX4, where THR_MDL_FAC is the curve."""
    hover_w: float
    endurance_min: float
    """Hover time on a full pack [min]."""
    top_speed_m_s: float
    """Speed after 30 s of full speed command [m/s]."""
    range_km: float
    """Distance on a full pack at the speed with the least energy per metre [km]."""
    range_speed_m_s: float
    stopping_m: dict[str, float]
    """Stopping distance [m] by speed [m/s]."""
    steps: dict[str, StepFigures]
    motors: tuple[MotorPoint, ...]
    warnings: tuple[str, ...]
    bench: BenchFit | None = None
    """Fit to the bench table; None without a table."""


def check_airframe(
    vehicle: str,
    computer: str = "workstation",
    payload: Payload | None = None,
    motor_data: Path | None = None,
) -> AirframeFigures:
    """Return the figures of a vehicle.

    Args:
        vehicle: Name or path of a vehicle profile.
        computer: Name or path of the profile of its onboard computer.
        payload: Carried mass; None = no payload.
        motor_data: Bench table of one motor, a CSV file with the columns throttle_percent,
            thrust_n or thrust_g, current_a and optionally voltage_v (default: full pack).
            Thrust and drive efficiency are fitted to it; None = values of the profile.

    Raises:
        UsageError: A profile or the bench table is unusable.
    """
    profile, board = equipped(vehicle, computer, payload or Payload())
    bench = None
    if motor_data is not None:
        profile, bench = _fit_motor(profile, motor_data)
    airframe = Airframe.from_profile(profile)
    constants = stopping.gym_constants_of(profile)
    weight_n = airframe.mass * GRAVITY_M_S2
    share = weight_n / profile.thrust_n
    energy_j = profile.battery.energy_j(1.0)
    speeds = np.arange(0.5, constants.gains.vel_max_xy + 0.25, 0.25)
    powers = level_powers_w(profile, np.array([0.0, *speeds])) + board.onboard_watts
    best = int(np.argmin(powers[1:] / speeds))
    braking = stopping.braking_of(profile)
    figures = AirframeFigures(
        mass_kg=airframe.mass,
        thrust_to_weight=1.0 / share,
        hover_throttle=command_for(share, airframe.thrust_curve),
        hover_thrust_share=share,
        hover_w=float(powers[0]),
        endurance_min=energy_j / float(powers[0]) / 60.0,
        top_speed_m_s=_top_speed(constants),
        range_km=1e-3 * energy_j * float(speeds[best] / powers[1 + best]),
        range_speed_m_s=float(speeds[best]),
        stopping_m={
            f"{speed:g}": braking.stopping_m(speed, 0.0)
            for speed in (2.0, 4.0, 8.0, braking.fastest_m_s)
            if speed <= braking.fastest_m_s
        },
        steps=_step_figures(constants),
        motors=tuple(_motor_points(profile)),
        warnings=(),
        bench=bench,
    )
    return replace(figures, warnings=tuple(_warnings(profile, figures)))


def _fit_motor(profile: VehicleProfile, path: Path) -> tuple[VehicleProfile, BenchFit]:
    """Return a vehicle with constants fitted to a bench table, and the fit. Raises UsageError.

    Least squares of thrust and of relative power: absolute power would fit full throttle only.
    """
    power, battery, n = profile.power, profile.battery, len(CORNERS)
    if power.model != "momentum":
        raise errors.UsageError(f"{path}: power.model = {power.model}: accepted: momentum")
    airframe = Airframe.from_profile(profile)
    unit = PowerModel.from_profile(profile)._replace(avionics_w=0.0, drive=1.0)

    def shaft_w(thrusts: NDArray[Any]) -> NDArray[Any]:
        return np.array([standing_power_w(n * each, airframe, unit) / n for each in thrusts])

    table = _read_bench(path)
    u, current = table["throttle_percent"] / 100.0, table["current_a"]
    grams = table.get("thrust_g", np.empty(0))
    thrust = table.get("thrust_n", grams * GRAVITY_M_S2 / G_PER_KG)
    volts = table.get("voltage_v", np.full_like(u, battery.cells * battery.cell_full_v))
    on = (u > 0.0) & (thrust > 0.0) & (current > 0.0)
    if (found := len(np.unique(u[on]))) < 3:
        problem = f"{found} throttles with thrust and current: accepted: at least 3"
        raise errors.UsageError(f"{path}: {problem}")
    square, linear = np.linalg.lstsq(np.column_stack((u * u, u)), thrust)[0]
    # `command_for` loses digits for a curve that is almost 0.
    curve = np.clip(square / (square + linear), 0.0, 1.0).round(4)
    shape = curve * u * u + (1.0 - curve) * u
    most = shape @ thrust / (shape @ shape)
    ratio = shaft_w(thrust[on]) / (volts * current)[on]
    drive = ratio @ ratio / ratio.sum()
    if not 0.1 <= drive <= 1.0:
        raise errors.UsageError(
            f"{path}: drive_efficiency = {drive:.3g} at figure_of_merit = {power.figure_of_merit:g}"
            ": accepted: 0.1 to 1; check units, figure_of_merit and propeller_diameter_m"
        )
    data = profile.model_dump()
    data["rotor"] |= {"thrust_max_n": most, "thrust_curve": curve}
    data["power"] |= {"drive_efficiency": drive}
    fitted = fields.validated(VehicleProfile, data, path)
    measured = np.column_stack((thrust, current))
    model = np.column_stack((most * shape, shaft_w(most * shape) / drive / volts))
    return fitted, BenchFit(most, curve, drive, power.figure_of_merit, u, measured, model)


def _read_bench(path: Path) -> dict[str, NDArray[Any]]:
    """Return the columns of a bench table by name. Raises UsageError."""
    try:
        text = read_limited(path, "a table", MOST_BYTES).decode("utf-8-sig").rstrip()
    except UnicodeDecodeError as error:
        raise errors.UsageError(f"{path}: not UTF-8 text: {error}") from None
    lines = [[cell.strip(' "\t') for cell in line.split(",")] for line in text.splitlines()]
    names, values = lines[0] if lines else [], []
    required = [{"throttle_percent", thrust, "current_a"} for thrust in ("thrust_n", "thrust_g")]
    if len(set(names)) < len(names) or set(names) - {"voltage_v"} not in required:
        raise errors.UsageError(
            f"{path}, line 1: {errors.shown(','.join(names))}: accepted: throttle_percent, "
            "thrust_n or thrust_g, current_a, and optionally voltage_v"
        )
    for number, cells in enumerate(lines[1:], 2):
        place = f"{path}, line {number}"
        if len(cells) != len(names):
            raise errors.UsageError(f"{place}: {len(cells)} values: accepted: {len(names)}")
        for name, cell in zip(names, cells, strict=True):
            low, high = BENCH_RANGES.get(name, (0.0, 1e3))
            try:
                values.append(float(cell))
            except ValueError:
                values.append(np.nan)
            if not low <= values[-1] <= high:
                found = f"{name} = {errors.shown(cell)}"
                raise errors.UsageError(f"{place}: {found}: accepted: {low:g} to {high:,.0f}")
    return dict(zip(names, np.reshape(values, (-1, len(names))).T, strict=True))


def _top_speed(constants: fleet.FleetConstants) -> float:
    flown = stopping.run_ups(constants, [constants.gains.vel_max_xy], [TOP_SPEED_S])
    return float(np.hypot(flown.velocity[0, 0], flown.velocity[0, 1]))


def _step_figures(constants: fleet.FleetConstants) -> dict[str, StepFigures]:
    n = len(STEPS)
    flown, arenas = fleet.new_fleet(n), stopping.open_space(n)
    for i, (column, value) in enumerate(STEPS.values()):
        fleet.hover(flown, i, 50.0, constants)
        flown.setpoint[i, column] = value
    samples = round(STEP_S / TICK_S) // SAMPLE_TICKS
    rows = np.empty((samples, n))
    ticks = np.full(n, SAMPLE_TICKS, np.int64)
    for k in range(samples):
        fleet_step.advance(flown, arenas, ticks, constants, stopping.RULES, None)
        rows[k] = flown.velocity[0, 0], flown.velocity[1, 2], flown.omega[2, 2]
    times = TICK_S * SAMPLE_TICKS * np.arange(1.0, samples + 1.0)
    return {
        name: _response(times, rows[:, i] / value)
        for i, (name, (_, value)) in enumerate(STEPS.items())
    }


def _response(times: NDArray[Any], share: NDArray[Any]) -> StepFigures:
    """Return the figures of a response (n,), as a share of the step, at times (n,) [s]."""
    reached = [np.flatnonzero(share >= level) for level in (0.1, 0.9)]
    outside = np.flatnonzero(np.abs(share - 1.0) > SETTLED)
    last = int(outside[-1]) + 1 if outside.size else 0
    return StepFigures(
        rise_s=float(times[reached[1][0]] - times[reached[0][0]]) if reached[1].size else None,
        overshoot_percent=100.0 * max(0.0, float(share.max()) - 1.0),
        settle_s=float(times[last]) if last < len(times) else None,
    )


def _motor_points(profile: VehicleProfile) -> list[MotorPoint]:
    airframe, model = Airframe.from_profile(profile), PowerModel.from_profile(profile)
    full_v = profile.battery.cells * profile.battery.cell_full_v
    points = []
    for throttle in THROTTLES:
        thrust_n = airframe.thrust_max * steady_speed(throttle, airframe.thrust_curve) ** 2
        power_w = standing_power_w(len(CORNERS) * thrust_n, airframe, model)
        # V = E - R I, so the current solves R I² - E I + P = 0 on its smaller root.
        resistance = profile.battery.resistance_ohm
        root = np.sqrt(max(0.0, full_v * full_v - 4.0 * resistance * power_w))
        current_a = 2.0 * power_w / (full_v + root)
        points.append(MotorPoint(throttle, float(thrust_n), float(current_a), float(power_w)))
    return points


def _warnings(profile: VehicleProfile, found: AirframeFigures) -> list[str]:
    built_in = profile.flown_parameters()["MPC_THR_HOVER"]
    lines = []
    hovers = [("parameters", built_in, found.hover_throttle)]
    if profile.px4 is not None:
        value = float(profile.px4.parameters.get("MPC_THR_HOVER", 0.5))
        hovers.append(("px4.parameters", value, found.hover_thrust_share))
    for table, value, needed in hovers:
        if abs(value - needed) > HOVER_TOLERANCE * needed:
            lines.append(f"{table}.MPC_THR_HOVER = {value:.3g}, the vehicle hovers at {needed:.3f}")
    if found.thrust_to_weight < MIN_THRUST_TO_WEIGHT:
        lines.append(
            f"thrust to weight {found.thrust_to_weight:.2f}: below {MIN_THRUST_TO_WEIGHT:g}, wind "
            "and manoeuvres saturate the motors"
        )
    for name, step in found.steps.items():
        if step.settle_s is None or step.overshoot_percent > 30.0:
            lines.append(f"{name}: the flight controller's gains do not fit this vehicle")
    if profile.response is None:
        lines.append("no table [response]: --compensate is unsupported, see scripts/fit-response")
    return lines


class VehicleOptions(fields.ProfileModel):
    """Show the figures of an aircraft before it flies.

    Step responses use the built-in flight controller with the profile's gains.

    Examples:
        airl vehicle quad
        airl vehicle my-quad.toml --motor-data motor.csv
    """

    vehicle: Annotated[str, POSITIONAL] = Field(
        default="quad", description="vehicle profile, a shipped name or a path to a .toml"
    )
    computer: str = Field(
        default="workstation", description="computer profile on board, a shipped name or a path"
    )
    payload: Payload = Field(default_factory=Payload, description="carried mass")
    motor_data: Path | None = fields.optional(
        "bench table of one motor, a .csv; its fit replaces thrust and drive efficiency"
    )


OPTIONS = VehicleOptions


def run(options: VehicleOptions, console: Console | None = None) -> int:
    """Print the figures; return 0. Raises UsageError as `check_airframe` does."""
    console = console or progress.new_console()
    found = check_airframe(options.vehicle, options.computer, options.payload, options.motor_data)
    document.print_facts(_facts(found), console)
    bench = [] if found.bench is None else [_bench_table(found.bench)]
    for table in (_step_table(found), _motor_table(found), *bench):
        console.print()
        document.print_table(table, console)
    console.print()
    for line in found.warnings:
        console.print(f"warning: {line}", soft_wrap=True, highlight=False)
    return 0


def _facts(found: AirframeFigures) -> document.Facts:
    stops = ", ".join(
        f"{metres:.1f} m from {speed} m/s" for speed, metres in found.stopping_m.items()
    )
    return (
        ("take-off mass", f"{found.mass_kg:.3f} kg"),
        ("thrust to weight", f"{found.thrust_to_weight:.2f}"),
        (
            "hover throttle",
            f"{found.hover_throttle:.3f} (PX4's MPC_THR_HOVER: {found.hover_thrust_share:.3f})",
        ),
        ("hover power", f"{found.hover_w:.0f} W"),
        ("endurance", f"{found.endurance_min:.1f} min in a hover"),
        ("range", f"{found.range_km:.1f} km at {found.range_speed_m_s:g} m/s"),
        ("top speed", f"{found.top_speed_m_s:.1f} m/s"),
        ("stopping distance", stops),
    )


def _step_table(found: AirframeFigures) -> document.TableView:
    def seconds(value: float | None) -> str:
        return document.NONE if value is None else f"{value:.2f}"

    rows = tuple(
        (name, seconds(step.rise_s), f"{step.overshoot_percent:.0f}", seconds(step.settle_s))
        for name, step in found.steps.items()
    )
    columns = document.columns_of("<step | rise [s] | overshoot [%] | settled [s]")
    return document.TableView("steps", "Step responses", columns, rows)


def _motor_table(found: AirframeFigures) -> document.TableView:
    rows = tuple(
        (f"{100 * m.throttle:.0f}", f"{m.thrust_n:.2f}", f"{m.current_a:.1f}", f"{m.power_w:.0f}")
        for m in found.motors
    )
    columns = document.columns_of("throttle [%] | thrust of a motor [N] | current [A] | power [W]")
    notes = ("Current and power of all motors on a full pack, in a static test.",)
    return document.TableView("motors", "Motors", columns, rows, notes)


def _bench_table(fit: BenchFit) -> document.TableView:
    off = fit.model - fit.measured
    thrust_rms, current_rms = np.sqrt(np.mean(off**2, axis=0))
    figures = np.dstack((fit.measured, fit.model, off)).reshape(-1, 6)
    rows = tuple(
        (f"{100 * u:g}", *(f"{figure:.2f}" for figure in row))
        for u, row in zip(fit.throttle, figures, strict=True)
    )
    columns = document.columns_of(
        "throttle [%] | thrust [N] | model | difference | current [A] | model | difference"
    )
    product = fit.figure_of_merit * fit.drive_efficiency
    notes = (
        f"Root-mean-square difference: {thrust_rms:.2f} N, {current_rms:.2f} A.",
        f"A table identifies only figure_of_merit * drive_efficiency = {product:.3f}.",
        "Lines for the profile:",
        f"[rotor]\nthrust_max_n = {fit.thrust_max_n:.4g}\nthrust_curve = {fit.thrust_curve:.4g}",
        f"[power]\ndrive_efficiency = {fit.drive_efficiency:.4g}",
    )
    return document.TableView("bench", "Bench table of one motor", columns, rows, notes)
