"""Figure of a flight over time: the policy's images, its commands and the flown motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import BboxImage
from matplotlib.lines import Line2D
from matplotlib.transforms import Bbox, TransformedBbox
from numpy.typing import NDArray

from airl_mav.report import theme
from airl_mav.report.policy_view import SeenDecision
from airl_mav.report.theme import pictured
from airl_mav.report.tracking import Commands, Floats, TrackedFlight

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

COMMANDED = theme.MARK
FLOWN = theme.SERIES
ESTIMATED = "#2c9a5b"
"""Colour of medium lightness, legible on light and dark backgrounds."""


@dataclass(frozen=True)
class _Line:
    """Line of a row."""

    values: Floats
    colour: str
    dashes: str = "-"
    wide: float = 1.1


def tracking_figure(
    flight: TrackedFlight, seen: Sequence[SeenDecision] = (), range_m: float = 0.0
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
            lines.append(_Line(was, FLOWN))
        if believed is not None and name != "yaw_rate_deg_s":
            lines.append(_Line(believed, ESTIMATED, "--", 0.9))
        if name in flight.commands.values:
            lines.append(_Line(held(flight.commands, name, t), COMMANDED, "-", 0.9))
        rows.append((LABELS[name], lines))
    lines = [_Line(flown.height_m, FLOWN)]
    if estimated is not None:
        lines.append(_Line(estimated.height_m, ESTIMATED, "--", 0.9))
    if flight.altitude_m is not None:
        asked = np.where(t >= 0.0, flight.altitude_m, np.nan)
        lines.append(_Line(asked, COMMANDED, "-", 0.9))
    rows.append(("height\n[m]", lines))
    if "roll_deg" not in flight.commands.values:
        tilt = [_Line(flown.roll_deg, FLOWN), _Line(flown.pitch_deg, FLOWN, ":")]
        rows.append(("roll [°]\npitch: dotted", tilt))
    if errors is not None:
        away = [_Line(errors.aside_m, ESTIMATED), _Line(errors.height_m, ESTIMATED, ":")]
        rows.append(("est. error [m]\nheight: dotted", away))
    if flight.power_w is not None:
        rows.append(("power\n[W]", [_Line(flight.power_w, FLOWN)]))
    if flight.motors is not None:
        rows.append(("motor\noutputs", [_Line(each, FLOWN, "-", 0.7) for each in flight.motors.T]))
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
    kinds = [("commanded", COMMANDED, "-"), ("flown", FLOWN, "-")]
    if flight.estimated is not None:
        kinds.append(("estimated", ESTIMATED, "--"))
    return [Line2D([], [], color=colour, ls=dashes, label=name) for name, colour, dashes in kinds]
