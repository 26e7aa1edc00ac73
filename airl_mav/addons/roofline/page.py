"""Points of computers on a vehicle's roofline, and the page: curves, points, bottlenecks.

Based on the F-1 model (`latency.stages.f1_velocity`), with measured braking, and verified in
flights.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from itertools import product
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from airl_mav.arena.geometry import Shape
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core import constants, fields
from airl_mav.envs import stopping
from airl_mav.envs.arena_batch import ArenaBatch
from airl_mav.envs.cameras import Cameras
from airl_mav.envs.fleet import Fleet, FlightStatus, hover, new_fleet
from airl_mav.envs.fleet_step import advance
from airl_mav.latency.injection import (
    FixedSampler,
    Injection,
    LatencySampler,
    latency_generator,
    longest_ms,
)
from airl_mav.latency.stages import f1_knee_hz, f1_velocity, max_acceleration
from airl_mav.policy.actions import commands
from airl_mav.policy.layouts import encode_layout
from airl_mav.policy.observation import InFlight, Kinematics, observe
from airl_mav.policy.registry import LearnedPolicy
from airl_mav.profiles.computer import ComputerProfile
from airl_mav.profiles.vehicle import SensorNoise, VehicleProfile
from airl_mav.report import document, theme
from airl_mav.vehicle.power import level_powers_w

if TYPE_CHECKING:
    from airl_mav.addons.roofline.roofline import RooflineRequest

MISSION_M = 100.0
"""Length of a mission, flown level at the safe velocity [m]."""

Bound = Literal["body", "sensor", "computer", "hold", "link"]
"""Component that limits the speed."""


class Shares(fields.ProfileModel):
    """Contributions to the longest reaction time [s]."""

    sensor: float
    """Frame period and transport."""
    computer: float
    """Twice the longest t2."""
    hold: float
    """Hold time of the policy's action."""
    link: float
    """Link, and a tick of the flight controller."""


class RooflinePoint(fields.ProfileModel):
    """Computer on the roofline of its vehicle."""

    computer: str
    description: str
    mass_g: float
    """Mass on board [g]."""
    watts: float
    """Power from the pack [W]."""
    latency: str
    """Description of t2."""
    vehicle_kg: float
    room_m: float
    """Sensing distance minus the hull's overhang: d of the model [m]."""
    reaction_s: float
    """T: time from an obstacle's appearance to the motors' response [s]."""
    shares: Shares
    max_acceleration_m_s2: float
    """a of the F-1 model: tilt limit and thrust [m/s²]."""
    f1_m_s: float
    """Safe velocity by the F-1 model [m/s]."""
    f1_roof_m_s: float
    f1_knee_hz: float
    braking: stopping.Braking
    measured_m_s: float
    """Safe velocity by the measured braking [m/s]."""
    roof_m_s: float
    """Safe velocity by the measured braking at T = 0 [m/s]."""
    knee_hz: float
    """Rate 1 / T at which the safe velocity reaches `knee_share` of the roof [Hz]."""
    flown_m_s: float
    """Maximum speed without a collision in any flight [m/s]."""
    binds: Bound
    power_w: float
    """Power of level flight at the measured safe velocity, with the computer [W]."""
    missions_per_charge: float

    @property
    def rate_hz(self) -> float:
        """Decision rate 1 / T [Hz]."""
        return 1.0 / self.reaction_s


class LeftOut(fields.ProfileModel):
    """Computer that is not on the roofline, and the reason."""

    computer: str
    why: str


class Roofline(fields.ProfileModel):
    """Roofline of a vehicle and its computers."""

    vehicle: str
    policy: str
    workload: str
    sensing_distance_m: float
    noticed_m: tuple[float, ...] = Field(description="depths at which the policy took notice")
    """Depths at which the policy reacts [m]; empty if the sensing distance was given."""
    frame_rate_hz: float
    hold_s: float
    knee_share: float
    draws: int
    seed: int
    points: tuple[RooflinePoint, ...]
    left_out: tuple[LeftOut, ...] = ()


def roofline_point(
    name: str,
    computer: ComputerProfile,
    task: stopping.StoppingTask,
    injection: Injection,
    request: RooflineRequest,
) -> RooflinePoint:
    """Compute a computer's point on the roofline of its vehicle, and fly it.

    Args:
        name: Name of the computer's profile.
        computer: The computer.
        task: The vehicle with this computer, its decision loop and its sensing distance.
        injection: t2 as measured on the computer; must have a latency.
        request: Knee, mission, number of flights and seed.

    Raises:
        ValueError: The injection has no latency.
        FieldError: The sensing distance ends within the hull.
    """
    if injection.latency is None:
        raise ValueError(f"{name}: no latency")
    t2_s = longest_ms(injection.latency) / constants.MS_PER_S
    loop, vehicle = task.loop, task.vehicle
    measured, reaction = task.safe_velocity(t2_s), loop.reaction_s(t2_s)
    parts: dict[Bound, float] = {
        "sensor": loop.frame_period_s + loop.transport_s,
        "computer": 2.0 * t2_s,
        "hold": loop.hold_s,
        "link": loop.link_s + constants.TICK_S,
    }
    braking, room, a = stopping.braking_of(vehicle), task.room_m, max_acceleration(vehicle)
    roof = braking.safe_velocity(0.0, room)
    at_knee = request.knee_share * roof
    braked = braking.stopping_m(at_knee, 0.0)
    knee_hz = (braking.stopping_m(at_knee, 1.0) - braked) / (room - braked)
    power_w = float(level_powers_w(vehicle, np.array([measured]))[0]) + computer.onboard_watts
    pack_j = vehicle.battery.energy_j(1.0)
    return RooflinePoint(
        computer=name,
        description=computer.description,
        mass_g=constants.G_PER_KG * computer.onboard_mass_kg,
        watts=computer.onboard_watts,
        latency=injection.label,
        vehicle_kg=vehicle.body.mass_kg,
        room_m=room,
        reaction_s=reaction,
        shares=Shares(**parts),
        max_acceleration_m_s2=a,
        f1_m_s=f1_velocity(reaction, room, a),
        f1_roof_m_s=f1_velocity(0.0, room, a),
        f1_knee_hz=f1_knee_hz(request.knee_share, room, a),
        braking=braking,
        measured_m_s=measured,
        roof_m_s=roof,
        knee_hz=knee_hz,
        flown_m_s=greatest_speed(task, injection, t2_s, request.draws, request.seed),
        binds="body" if 1.0 / reaction >= knee_hz else max(parts, key=lambda part: parts[part]),
        power_w=power_w,
        missions_per_charge=pack_j * measured / (power_w * MISSION_M),
    )


HALF_WIDTHS_M = (0.5, 1.0, 1.5)
"""Half widths of the box ahead, covering the built-in arenas [m]."""

ASIDE = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Offset of the box's middle from the flight path, in half widths; it is always in the way."""

GOALS = ((15.0, 0.0), (25.0, -0.3), (25.0, 0.0), (25.0, 0.3), (40.0, 0.0))
"""Distance [m] and bearing [rad] of the goal."""

STEP_M = 0.2
HALF_HEIGHT_M = 2.0

SAME = 0.01
"""Tolerance for equal commands, relative to the maximum speed."""


def noticed_m(policy: LearnedPolicy, vehicle: VehicleProfile) -> NDArray[np.float64]:
    """Return the depths at which a policy reacts to a box ahead, one per situation (75,) [m].

    The vehicle flies level and straight at the policy's maximum speed towards the box. The depth is
    the maximum at which, as at all smaller depths, the action differs from the action in open
    space; 0 = no such depth.

    Args:
        policy: Its camera must match the vehicle's.
        vehicle: Vehicle with the camera.
    """
    camera, card = vehicle.camera, policy.card
    depths = np.arange(STEP_M, camera.range_m, STEP_M)
    n = len(depths) + 1  # the last row flies in open space
    fleet, arenas, shared = (
        new_fleet(n),
        stopping.open_space(n, obstacles=1),
        stopping.gym_constants_of(vehicle),
    )
    for i in range(n):
        hover(fleet, i, stopping.ALTITUDE_M, shared)
    fleet.velocity[:, 0] = card.actions.max_speed_m_s
    arenas.n_obstacles[:-1] = 1
    arenas.shape[:] = Shape.BOX
    cameras = Cameras(n, camera, 0, SensorNoise())
    found = []
    for half_m, aside, (away_m, bearing) in product(HALF_WIDTHS_M, ASIDE, GOALS):
        arenas.half_size[:] = (half_m, half_m, HALF_HEIGHT_M)
        arenas.center[:-1, 0, 0] = camera.forward_m + depths + half_m
        arenas.center[:-1, 0, 1] = aside * half_m
        arenas.center[:-1, 0, 2] = -HALF_HEIGHT_M
        arenas.goal[:, :2] = (away_m * math.cos(bearing), away_m * math.sin(bearing))
        cameras.capture(fleet, arenas, np.ones(n, np.bool_), np.zeros(n, np.int64))
        state = Kinematics(fleet.position, fleet.velocity, fleet.quaternion)
        seen = observe(
            *(cameras.image, Intrinsics.of(camera), state, arenas.goal[:, :2]),
            InFlight.of_first_decisions(n),
        )
        # For policies with memory: the first decision of a flight.
        fresh = policy.with_generator(np.random.default_rng(0)) if card.state else policy
        chosen = commands(card.actions, fresh.act_batch(encode_layout(card.observation, seen)))
        moved = np.abs(chosen[:-1] - chosen[-1]).max(axis=1)
        ignored = np.flatnonzero(moved <= SAME * card.actions.max_speed_m_s)
        reach = ignored[0] if ignored.size else len(depths)
        found.append(depths[reach - 1] if reach else 0.0)
    return np.array(found)


# --- the page

BINDS: dict[Bound, str] = {
    "body": "body: beyond the knee, deciding sooner gains little",
    "sensor": "sensor: the wait for a frame is the longest part",
    "computer": "computer: its inference is the longest part",
    "hold": "hold: the policy's action is held for the longest part",
    "link": "link: the way of the setpoint is the longest part",
}

RATES = 200
"""Number of points of a curve."""


def roofline_document(found: Roofline, made: Mapping[str, Any]) -> document.Document:
    """Return the document of a roofline with one or more points; `made` is its provenance."""
    return document.Document(
        name="roofline",
        title=f"Roofline of {found.vehicle}",
        kicker=f"Safe velocity by reaction time · {found.policy} · {found.workload}",
        answers=tuple(_answer(point) for point in found.points)
        + tuple(f"{each.computer} left out: {each.why}." for each in found.left_out),
        sections=(
            document.Section(
                "Safe velocity",
                tables=(velocity_table(found), reaction_table(found), aircraft_table(found)),
                draw=lambda: [roofline_picture(found)],
            ),
        ),
        facts=_facts(found),
        provenance=(
            ("command", f"{made['command']}"),
            *document.provenance_facts(made["machine"], made["git"], made["versions"]),
        ),
        configurations=(("the roofline", json.dumps(found.model_dump(), indent=2)),),
        footer="Figures as data in roofline.json beside this page",
    )


def _answer(point: RooflinePoint) -> str:
    return (
        f"{point.computer}: {point.measured_m_s:.2f} m/s is safe, {point.flown_m_s:.2f} m/s was "
        f"flown without a touch; {BINDS[point.binds]}."
    )


def _facts(found: Roofline) -> document.Facts:
    distance = f"{found.sensing_distance_m:.1f} m"
    if found.noticed_m:
        depths = np.array(found.noticed_m)
        distance += (
            f", the least of {len(depths)} depths at which {found.policy} changed its action for a "
            f"box in its way (median {np.median(depths):.1f} m)"
        )
    return (
        ("vehicle", found.vehicle),
        ("camera", f"{found.frame_rate_hz:g} frames a second"),
        ("sensing distance", distance),
        ("policy", f"{found.policy}, holds an action for {found.hold_s:g} s"),
        ("latency", found.workload),
        ("knee", f"at {100.0 * found.knee_share:g} % of the roof"),
        ("flown", f"{found.draws:,} flights at each speed, seed {found.seed}"),
    )


def velocity_table(found: Roofline) -> document.TableView:
    """Return the safe velocity on each computer: model, measurement, flight and roofs."""
    columns = document.columns_of(
        "<computer | F-1 [m/s] | measured [m/s] | flown [m/s] | "
        "roof, F-1 [m/s] | roof [m/s] | <binds"
    )
    rows = tuple(
        (
            point.computer,
            f"{point.f1_m_s:.2f}",
            f"{point.measured_m_s:.2f}",
            f"{point.flown_m_s:.2f}",
            f"{point.f1_roof_m_s:.2f}",
            f"{point.roof_m_s:.2f}",
            point.binds,
        )
        for point in found.points
    )
    notes = (
        "F-1: the closed form, braking as hard as tilt limit and thrust permit. Measured: the "
        "vehicle's own way to a stand, with its computer on board. Flown: greatest speed at which "
        f"none of {found.draws:,} flights touched an obstacle that came up at the worst moment.",
    )
    return document.TableView("velocities", "Safe velocity", columns, rows, notes)


def aircraft_table(found: Roofline) -> document.TableView:
    """Return mass and power of each computer on board, and the missions per charge."""
    columns = document.columns_of(
        "<computer | on board [g] | draws [W] | take-off mass [kg] | power [W] | missions"
    )
    rows = tuple(
        (
            point.computer,
            f"{point.mass_g:g}",
            f"{point.watts:g}",
            f"{point.vehicle_kg:.3f}",
            f"{point.power_w:.0f}",
            f"{point.missions_per_charge:.1f}",
        )
        for point in found.points
    )
    notes = (
        f"Missions: {MISSION_M:g} m each, on a full charge, level at the measured safe "
        "velocity; take-off, landing and manoeuvres come on top.",
    )
    return document.TableView("aircraft", "With the computer on board", columns, rows, notes)


def reaction_table(found: Roofline) -> document.TableView:
    """Return the parts of each computer's reaction time, and the knee."""
    columns = document.columns_of(
        "<computer | sensor [s] | 2 x t2 [s] | hold [s] | link [s] | "
        "T [s] | 1 / T [Hz] | knee, F-1 [Hz] | knee [Hz]"
    )
    rows = tuple(
        (
            point.computer,
            *(f"{each:.3f}" for each in point.shares.model_dump().values()),
            f"{point.reaction_s:.3f}",
            f"{point.rate_hz:.2f}",
            f"{point.f1_knee_hz:.2f}",
            f"{point.knee_hz:.2f}",
        )
        for point in found.points
    )
    notes = (
        "T: from an obstacle's coming up to the motors' answer, at the worst moment: just after "
        "the frame of a decision, which then infers and holds before the next one sees it. t2 is "
        "the 99.9 % quantile, or the greatest sample.",
        *(f"{point.computer}: {point.latency}." for point in found.points),
    )
    return document.TableView("reaction", "Reaction time", columns, rows, notes)


def roofline_picture(found: Roofline) -> theme.FigureImage:
    """Draw safe velocity against 1 / T with the curves and points of each computer."""
    figure = theme.new_figure(7.2, 4.6)
    ax = figure.add_subplot()
    theme.plain_axes(ax)
    theme.logarithmic(ax, "x")
    known = [hz for p in found.points for hz in (p.rate_hz, p.knee_hz, p.f1_knee_hz)]
    rates = np.geomspace(0.4 * min(known), 4.0 * max(known), RATES)
    for index, point in enumerate(found.points):
        colour = theme.line_style(index).colour
        a, room = point.max_acceleration_m_s2, point.room_m
        model = [f1_velocity(1.0 / hz, room, a) for hz in rates]
        measured = [point.braking.safe_velocity(1.0 / hz, room) for hz in rates]
        ax.plot(rates, model, color=colour, linestyle="--", linewidth=1.0)
        ax.plot(rates, measured, color=colour, linewidth=1.6, label=point.computer)
        ax.axhline(point.roof_m_s, color=colour, linestyle=":", linewidth=0.8)
        knee = found.knee_share * point.roof_m_s
        ax.plot(point.knee_hz, knee, color=colour, marker="|", markersize=12)
        ax.plot(point.rate_hz, point.measured_m_s, color=colour, marker="o", markersize=6)
        ax.plot(point.rate_hz, point.flown_m_s, color=colour, marker="x", markersize=7)
    ax.set_ylim(bottom=0.0)
    ax.set_xlim(rates[0], rates[-1])
    theme.label_axes(ax, "reactions a second, 1 / T [Hz]", "safe velocity [m/s]", found.vehicle)
    ax.annotate(
        "solid, dot: measured braking   dashed: F-1   cross: flown   bar: knee   dotted: roof",
        (0.01, 0.985),
        xycoords="axes fraction",
        fontsize=7.5,
        color=theme.MUTED,
        va="top",
    )
    theme.legend_below(figure, columns=4)
    told = "; ".join(f"{p.computer} {p.measured_m_s:.2f} m/s" for p in found.points)
    return theme.render(figure, "roofline", f"Safe velocity against 1 / T: {told}")


WALL_HALF_M = (0.5, 20.0, 5.0)
"""Half extents of the obstacle: too wide to fly around [m]."""


SPEED_STEP_M_S = 0.01
"""Resolution of the search for the maximum collision-free speed [m/s]."""


_LEAST_SPEED_M_S = 0.01


def fly_into(
    task: stopping.StoppingTask,
    speed_m_s: float,
    latency: Injection,
    native_s: float,
    draws: int,
    seed: int,
) -> NDArray[np.bool_]:
    """Fly level towards an obstacle that appears at the worst time, and stop.

    A wall appears at the sensing distance, just after the capture of a decision's frame. Latencies,
    phase between camera and decision, and time since the start from hover differ between flights.

    Args:
        task: Vehicle, timing and sensing distance.
        speed_m_s: Speed of the setpoint before the stop, > 0 [m/s].
        latency: Source of t2.
        native_s: t2 without injection [s].
        draws: Number of flights, n.
        seed: Seed of flight 0; flight i draws from seed + i.

    Returns:
        (n,) True for flights that touched the obstacle.
    """
    rngs = [latency_generator(seed + i) for i in range(draws)]
    samplers = [latency.sampler(rng) or FixedSampler(_us(native_s)) for rng in rngs]
    # Separate generators, so that the latencies depend on the seed alone.
    others = [np.random.default_rng((seed + i, draws)) for i in range(draws)]
    phases = np.array([rng.random(2) for rng in others])
    reaction_us = _reactions_us(task.loop, samplers, phases[:, 0])
    shared = stopping.gym_constants_of(task.vehicle)
    moments = (phases[:, 1] * len(stopping.MOMENTS_S)).astype(np.int64)
    flying = stopping.run_ups(shared, [speed_m_s], stopping.MOMENTS_S)
    fleet = Fleet._make(array[moments] for array in flying)
    walls = _walls(fleet.position, task)
    # A setpoint takes effect at the flight controller's next tick.
    advance(fleet, walls, -(-reaction_us // constants.TICK_US), shared, stopping.RULES, None)
    stopping.stop(fleet, walls, shared)
    touched: NDArray[np.bool_] = fleet.verdict == FlightStatus.COLLISION
    return touched


def greatest_speed(
    task: stopping.StoppingTask, latency: Injection, native_s: float, draws: int, seed: int
) -> float:
    """Return the maximum speed without a collision in `fly_into`, by bisection [m/s].

    At most the autopilot's maximum; 0 if the vehicle collides at any speed. Arguments as in
    `fly_into`.
    """

    def stands(speed_m_s: float) -> bool:
        return not fly_into(task, speed_m_s, latency, native_s, draws, seed).any()

    low, high = _LEAST_SPEED_M_S, stopping.braking_of(task.vehicle).fastest_m_s
    # The usual results first: no limit, or no speed at all.
    if stands(high):
        return high
    if not stands(low):
        return 0.0
    while high - low > SPEED_STEP_M_S:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stands(middle) else (low, middle)
    return low


def _us(time_s: float) -> int:
    return round(time_s * constants.US_PER_S)


def _reactions_us(
    loop: stopping.DecisionLoop, samplers: list[LatencySampler], phases: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return the time of each flight from the obstacle's appearance to the motors (n,) [µs].

    The frame at time 0 does not show the obstacle, later frames do. Decisions use the newest
    decoded frame; the first one uses the frame of time 0.
    """
    period_us, transport_us = _us(loop.frame_period_s), _us(loop.transport_s)
    times = np.zeros(len(samplers), np.int64)
    for i, sampler in enumerate(samplers):
        observed_us = transport_us + int(phases[i] * period_us)
        sent_us = observed_us + sampler.sample_us()
        # Until the first frame after time 0 has been decoded.
        while observed_us < transport_us + period_us:
            observed_us = sent_us + _us(loop.hold_s)
            sent_us = observed_us + sampler.sample_us()
        times[i] = sent_us + _us(loop.link_s)
    return times


def _walls(position: NDArray[np.float64], task: stopping.StoppingTask) -> ArenaBatch:
    """Return a wall for each vehicle (n, 3), at the sensing distance from its camera."""
    walls = stopping.open_space(len(position), obstacles=1)
    walls.n_obstacles[:] = 1
    walls.shape[:] = Shape.BOX
    walls.half_size[:] = WALL_HALF_M
    lens = position[:, 0] + task.vehicle.camera.forward_m
    walls.center[:, 0, 0] = lens + task.sensing_distance_m + WALL_HALF_M[0]
    walls.center[:, 0, 2] = -stopping.ALTITUDE_M
    return walls
