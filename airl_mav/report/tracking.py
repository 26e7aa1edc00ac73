"""Command tracking of a flight: commanded, flown and estimated motion, as data and as a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import BboxImage
from matplotlib.lines import Line2D
from matplotlib.transforms import Bbox, TransformedBbox
from numpy.typing import NDArray

from airl_mav.core import constants, files, frames
from airl_mav.flight import episode_record, trajectory
from airl_mav.latency.stamps import ATTITUDE, NO_STAMP, RATES, SETPOINT, commanded, setpoint_column
from airl_mav.rehearsal.run_folder import MOTOR_OUTPUTS, MOTOR_TIMES, LoadedRun, flown_path
from airl_mav.report import policy_view, theme
from airl_mav.report.theme import pictured

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TrackedMotion:
    """True or estimated motion of a vehicle at m times."""

    forward_m_s: Floats
    """Horizontal velocity (m,) along the heading."""
    right_m_s: Floats
    height_m: Floats
    """Height (m,) above the start."""
    yaw_rate_deg_s: Floats
    """Yaw rate (m,), clockwise from above, by differences of the heading between samples."""
    roll_deg: Floats
    pitch_deg: Floats
    heading_deg: Floats | None = None
    """Heading, -180 to 180; None here and below unless the commands include the quantity."""
    body_roll_rate_deg_s: Floats | None = None
    """Body rates about FRD axes, by differences between samples."""
    body_pitch_rate_deg_s: Floats | None = None
    body_yaw_rate_deg_s: Floats | None = None


COMMANDED: Mapping[str, tuple[str, ...]] = {
    SETPOINT: ("forward_m_s", "right_m_s", "", "yaw_rate_deg_s"),
    ATTITUDE: ("roll_deg", "pitch_deg", "heading_deg", "thrust"),
    RATES: ("body_roll_rate_deg_s", "body_pitch_rate_deg_s", "body_yaw_rate_deg_s", "thrust"),
}
"""Names of a setpoint's four numbers by its column: fields of `TrackedMotion`, and the thrust.
Numbers with an empty name are not shown. Values named _deg or _deg_s are recorded in rad."""


@dataclass(frozen=True)
class Commands:
    """Setpoints of n decisions; each holds until the next is sent."""

    sent_s: Floats
    """Send times (n,) since the start of navigation."""
    values: Mapping[str, Floats]
    """Values (n,) by name (`COMMANDED`). Velocities are in the heading frame, which may rotate
    during the hold."""


@dataclass(frozen=True)
class EstimateErrors:
    """Errors of the estimator at m times."""

    aside_m: Floats
    """Horizontal distance (m,) between estimated and true position."""
    height_m: Floats
    """Absolute height error (m,)."""
    velocity_m_s: Floats
    """Norm of the velocity error (m,)."""
    tilt_deg: Floats
    """Larger of the roll and pitch errors (m,)."""
    heading_deg: Floats


@dataclass(frozen=True)
class TrackedFlight:
    """Flight up to its verdict."""

    record: episode_record.EpisodeRecord
    time_s: Floats
    """Time (m,) since the start of navigation; negative before."""
    flown: TrackedMotion
    estimated: TrackedMotion | None
    """Estimated motion; None if not recorded."""
    errors: EstimateErrors | None
    commands: Commands
    altitude_m: float | None
    """Height setpoint [m]."""
    power_w: Floats | None
    """Electrical power (m,); None if not measured."""
    motors: Floats | None
    """Motor outputs (m, 4), 0 to 1, in PX4's order; None if not recorded."""


def track(run: LoadedRun, record: episode_record.EpisodeRecord) -> TrackedFlight | None:
    """Return commanded, flown and estimated motion of a flight; None without a path."""
    path = flown_path(run, record)
    if path is None or len(path) < 2:
        return None
    stamps = run.latency.get(record.index, {})
    flown, heading = _motion(path.time_us, path.position, path.velocity, path.quaternion)
    commands, pilot = commands_of(stamps, record.zero_us), run.info.config.get("pilot", {})
    if "heading_deg" in commands.values:
        flown = replace(flown, heading_deg=np.degrees(np.angle(np.exp(1j * heading))))
    elif "body_roll_rate_deg_s" in commands.values:
        flown = replace(flown, **_turned(path))
    estimated = errors = None
    if (recorded := trajectory.estimate_of(stamps)) is not None and len(recorded) > 1:
        believed = recorded.at(path.time_us)
        estimated, estimated_heading = _motion(
            path.time_us, believed.position, believed.velocity, believed.quaternion
        )
        errors = _errors(path, flown, heading, believed, estimated, estimated_heading)
    return TrackedFlight(
        record=record,
        time_s=(path.time_us - record.zero_us) / constants.US_PER_S,
        flown=flown,
        estimated=estimated,
        errors=errors,
        commands=commands,
        # The height setpoint applies only to velocity commands.
        altitude_m=pilot.get("altitude_m") if commanded(stamps) == "velocity" else None,
        power_w=path.power_w if np.isfinite(path.power_w).all() else None,
        motors=_motors(stamps, path.time_us),
    )


def _motors(stamps: files.Arrays, time_us: NDArray[np.int64]) -> Floats | None:
    times, outputs = stamps.get(MOTOR_TIMES), stamps.get(MOTOR_OUTPUTS)
    if times is None or outputs is None or len(times) < 2:
        return None
    columns = [np.interp(time_us, times, column, left=0.0, right=0.0) for column in outputs.T]
    return np.stack(columns, axis=1)


def commands_of(stamps: files.Arrays, zero_us: int) -> Commands:
    """Return the sent setpoints with times relative to `zero_us`."""
    sent = np.asarray(stamps.get("sent_us", np.zeros(0)), np.int64)
    column = setpoint_column(stamps) or SETPOINT
    setpoint = np.asarray(stamps.get(column, np.zeros((len(sent), 4))), np.float64)
    there = sent != NO_STAMP
    numbers = setpoint[there].T if there.any() else np.zeros((4, 0))
    values = {
        name: np.degrees(row) if name.endswith(("_deg", "_deg_s")) else row
        for name, row in zip(COMMANDED[column], numbers, strict=True)
        if name
    }
    return Commands((sent[there] - zero_us) / constants.US_PER_S, values)


def _motion(
    time_us: NDArray[np.int64], position: Floats, velocity: Floats, quaternion: Floats
) -> tuple[TrackedMotion, Floats]:
    roll, pitch, yaw = frames.quats_to_euler(quaternion)
    heading: Floats = np.unwrap(yaw)
    level = frames.ned_to_heading(velocity, heading)
    rate = np.gradient(heading, time_us / constants.US_PER_S)
    motion = TrackedMotion(
        forward_m_s=level[:, 0],
        right_m_s=level[:, 1],
        height_m=-position[:, 2],
        yaw_rate_deg_s=np.degrees(rate),
        roll_deg=np.degrees(roll),
        pitch_deg=np.degrees(pitch),
    )
    return motion, heading


def _turned(path: trajectory.Trajectory) -> dict[str, Floats]:
    """Return the body rates (m,) [deg/s] by their names in `TrackedMotion`."""
    q = path.quaternion
    turn = frames.quat_multiply((q[:-1] * (1.0, -1.0, -1.0, -1.0)).T, q[1:].T).T
    sine = np.linalg.norm(turn[:, 1:], axis=1)
    # q and -q are the same attitude; take the shorter rotation.
    angle = 2.0 * np.arctan2(sine, np.abs(turn[:, 0])) * np.where(turn[:, 0] < 0.0, -1.0, 1.0)
    passed_s = np.diff(path.time_us) / constants.US_PER_S
    steps = turn[:, 1:] * (angle / np.maximum(sine, 1e-12) / passed_s)[:, None]
    # The steps are rates between samples; each sample gets the mean of both sides.
    sides = np.concatenate([steps[:1], steps, steps[-1:]])
    rates = np.degrees(0.5 * (sides[:-1] + sides[1:]))
    return dict(zip(COMMANDED[RATES], rates.T, strict=False))


def _errors(
    path: trajectory.Trajectory,
    flown: TrackedMotion,
    heading: Floats,
    believed: trajectory.Trajectory,
    estimated: TrackedMotion,
    estimated_heading: Floats,
) -> EstimateErrors:
    away = believed.position - path.position
    tilts = np.abs([estimated.roll_deg - flown.roll_deg, estimated.pitch_deg - flown.pitch_deg])
    turned = np.angle(np.exp(1j * (estimated_heading - heading)))
    return EstimateErrors(
        aside_m=np.hypot(away[:, 0], away[:, 1]),
        height_m=np.abs(away[:, 2]),
        velocity_m_s=np.linalg.norm(believed.velocity - path.velocity, axis=1),
        tilt_deg=tilts.max(axis=0),
        heading_deg=np.abs(np.degrees(turned)),
    )


TIME_POINTS = 300
"""Maximum number of points of a line."""

WIDTH_IN, ROW_IN, STRIP_IN = 5.2, 0.86, 0.78
LEFT_IN, RIGHT_IN = 0.68, 0.12

BEFORE_S = 2.0
"""Time shown before navigation [s]; the whole take-off if navigation never started."""

IMAGES = 5

ALWAYS = ("forward_m_s", "right_m_s")
"""Rows of every flight, independent of its kind of commands."""

LABELS = {
    "forward_m_s": "forward\n[m/s]",
    "right_m_s": "right\n[m/s]",
    "yaw_rate_deg_s": "yaw rate\n[°/s]",
    "roll_deg": "roll\n[°]",
    "pitch_deg": "pitch\n[°]",
    "heading_deg": "heading\n[°]",
    "body_roll_rate_deg_s": "roll rate\n[°/s]",
    "body_pitch_rate_deg_s": "pitch rate\n[°/s]",
    "body_yaw_rate_deg_s": "yaw rate\n[°/s]",
    "thrust": "thrust\n[0..1]",
}

COMMANDED_COLOUR = theme.MARK
FLOWN_COLOUR = theme.SERIES
ESTIMATED_COLOUR = "#2c9a5b"
"""Colour of medium lightness, legible on light and dark backgrounds."""


@dataclass(frozen=True)
class _Line:
    """Line of a row."""

    values: Floats
    colour: str
    dashes: str = "-"
    wide: float = 1.1


def tracking_figure(
    flight: TrackedFlight, seen: Sequence[policy_view.SeenDecision] = (), range_m: float = 0.0
) -> theme.FigureImage:
    """Draw a flight over navigation time, with up to `IMAGES` images of decisions above."""
    rows = _rows(flight)
    strip = STRIP_IN if seen else 0.0
    height = 0.45 + 0.3 + strip + len(rows) * ROW_IN
    margins = theme.Margins(LEFT_IN, RIGHT_IN, 0.45, 0.3 + strip, 0.12)
    figure, axes = theme.stacked_axes(len(rows), WIDTH_IN, height, margins)
    t = flight.time_s
    first = 0
    if flight.record.navigation_us is not None:
        first = min(int(np.searchsorted(t, -BEFORE_S)), len(t) - 2)
    keep = np.unique(np.linspace(first, len(t) - 1, TIME_POINTS).astype(int))
    for ax, (label, lines) in zip(axes, rows, strict=True):
        _draw_row(ax, flight, label, lines, keep)
    for k, image in enumerate(seen):
        at = flight.commands.sent_s[min(image.number, len(flight.commands.sent_s) - 1)]
        _draw_image(figure, k, pictured(image.image, range_m), f"{at:.1f} s")
        for row in axes:
            row.axvline(at, color=theme.MUTED, lw=0.6, ls=":", zorder=1)
    if t[first] < 0.0:
        axes[0].annotate(
            "take-off", (t[first], 1.0), xycoords=("data", "axes fraction"), xytext=(3, -3),
            textcoords="offset points", va="top", fontsize=8, color=theme.MUTED,
        )  # fmt: skip
    theme.label_axes(axes[-1], "time since the start of navigation [s]")
    theme.share_grid(list(axes))
    figure.legend(
        handles=_legend(flight), loc="upper left", bbox_to_anchor=(LEFT_IN / WIDTH_IN, 1.0),
        ncols=3, frameon=False, fontsize=8, labelcolor=theme.INK, borderaxespad=0.1,
        handlelength=1.6, columnspacing=1.4,
    )  # fmt: skip
    number = flight.record.index
    alt = f"Flight {number} over time: " + ", ".join(label.partition(" [")[0] for label, _ in rows)
    return theme.render(figure, f"flight-{number:03d}-time", alt)


def _rows(flight: TrackedFlight) -> list[tuple[str, list[_Line]]]:
    flown, estimated, errors, t = flight.flown, flight.estimated, flight.errors, flight.time_s
    rows = []
    for name in dict.fromkeys((*ALWAYS, *flight.commands.values)):
        lines, believed = [], getattr(estimated, name, None)
        if (was := getattr(flown, name, None)) is not None:
            lines.append(_Line(was, FLOWN_COLOUR))
        if believed is not None and name != "yaw_rate_deg_s":
            lines.append(_Line(believed, ESTIMATED_COLOUR, "--", 0.9))
        if name in flight.commands.values:
            lines.append(_Line(held(flight.commands, name, t), COMMANDED_COLOUR, "-", 0.9))
        rows.append((LABELS[name], lines))
    lines = [_Line(flown.height_m, FLOWN_COLOUR)]
    if estimated is not None:
        lines.append(_Line(estimated.height_m, ESTIMATED_COLOUR, "--", 0.9))
    if flight.altitude_m is not None:
        asked = np.where(t >= 0.0, flight.altitude_m, np.nan)
        lines.append(_Line(asked, COMMANDED_COLOUR, "-", 0.9))
    rows.append(("height\n[m]", lines))
    if "roll_deg" not in flight.commands.values:
        tilt = [_Line(flown.roll_deg, FLOWN_COLOUR), _Line(flown.pitch_deg, FLOWN_COLOUR, ":")]
        rows.append(("roll [°]\npitch: dotted", tilt))
    if errors is not None:
        away = [
            _Line(errors.aside_m, ESTIMATED_COLOUR),
            _Line(errors.height_m, ESTIMATED_COLOUR, ":"),
        ]
        rows.append(("est. error [m]\nheight: dotted", away))
    if flight.power_w is not None:
        rows.append(("power\n[W]", [_Line(flight.power_w, FLOWN_COLOUR)]))
    if flight.motors is not None:
        rows.append(
            ("motor\noutputs", [_Line(each, FLOWN_COLOUR, "-", 0.7) for each in flight.motors.T])
        )
    return rows


def held(commands: Commands, name: str, time_s: Floats) -> Floats:
    """Return the newest setpoint at each time (m,); NaN before the first setpoint."""
    values = commands.values[name]
    if not len(values):
        return np.full(len(time_s), np.nan)
    which = np.searchsorted(commands.sent_s, time_s, side="right") - 1
    return np.where(which < 0, np.nan, values[np.maximum(which, 0)])


def _draw_row(
    ax: Axes, flight: TrackedFlight, label: str, lines: Sequence[_Line], keep: NDArray[np.int64]
) -> None:
    t = flight.time_s
    for line in lines:
        power = line.values is flight.power_w
        values = _mean_power(t, line.values, keep) if power else line.values[keep]
        ax.plot(t[keep], values, color=line.colour, ls=line.dashes, lw=line.wide)
    theme.label_axes(ax, y=label)
    ax.yaxis.label.set_fontsize(7.5)
    ax.margins(y=0.08)
    if t[keep[0]] < 0.0:
        ax.axvspan(t[keep[0]], 0.0, color=theme.RULE, alpha=0.45, lw=0)
    for begin_s, end_s in flight.record.fault_spans_s():
        ax.axvspan(begin_s, end_s, color=theme.MARK, alpha=0.12, lw=0)
    theme.plain_axes(ax)
    ax.locator_params(axis="y", nbins=4)
    ax.set_xlim(t[keep[0]], t[-1])


def _mean_power(time_s: Floats, power_w: Floats, keep: NDArray[np.int64]) -> Floats:
    """Return the mean power between kept samples; each sample is a mean since the previous."""
    steps = np.diff(time_s, prepend=time_s[0] - 1e-6)
    energy = np.cumsum(power_w * steps)
    passed = time_s[keep] - time_s[0] + 1e-6
    first = power_w[keep[0]]
    power: Floats = np.append(first, np.diff(energy[keep]) / np.diff(passed))
    return power


def _draw_image(figure: Figure, place: int, image: NDArray[np.uint8], title: str) -> None:
    """Draw an image (rows, columns, 3) with a title above the rows, without costly axes."""
    width, height = (float(inches) for inches in figure.get_size_inches())
    room = (WIDTH_IN - LEFT_IN - RIGHT_IN) / IMAGES
    centre = LEFT_IN + (place + 0.5) * room
    bottom, tall, wide = height - 0.3 - STRIP_IN + 0.04, STRIP_IN - 0.2, room - 0.08
    # The maximum size that fits with the image's aspect ratio.
    scale = min(wide / image.shape[1], tall / image.shape[0])
    across, up = scale * image.shape[1], scale * image.shape[0]
    left, low = centre - 0.5 * across, bottom + 0.5 * (tall - up)
    inches = Bbox.from_bounds(left, low, across, up)
    box = TransformedBbox(inches, figure.dpi_scale_trans)
    # Composite images would be resampled twice.
    figure.suppressComposite = True
    drawn = BboxImage(box, interpolation="nearest")
    drawn.set_data(image)
    figure.add_artist(drawn)
    figure.text(
        centre / width, (low + up + 2.0 / 72.0) / height, title,
        ha="center", va="baseline", fontsize=7.5, color=theme.MUTED,
    )  # fmt: skip


def _legend(flight: TrackedFlight) -> list[Line2D]:
    kinds = [("commanded", COMMANDED_COLOUR, "-"), ("flown", FLOWN_COLOUR, "-")]
    if flight.estimated is not None:
        kinds.append(("estimated", ESTIMATED_COLOUR, "--"))
    return [Line2D([], [], color=colour, ls=dashes, label=name) for name, colour, dashes in kinds]
