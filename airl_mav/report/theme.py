"""Figures for light and dark pages (SVG with CSS variables, light PNG), and depth colours."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import NullFormatter, StrMethodFormatter
from matplotlib.transforms import blended_transform_factory
from numpy.typing import NDArray
from PIL import Image

from airl_mav.arena.draw import FLOOR_COLOUR, GOAL_COLOUR, GRID_COLOUR, START_COLOUR, STATIC_COLOURS
from airl_mav.camera.frame import nearness, rgb_of
from airl_mav.core.files import replacing

NO_RETURN = "#262a30"
"""Colour of pixels without a depth return, as in the live view."""

LEVELS = 255
"""Number of shades from far to near."""


def shades(depth_mm: NDArray[np.uint16], range_m: float) -> NDArray[np.uint8]:
    """Return a depth image (h, w) [mm] as bytes: 0 no return, 1 at `range_m`, 255 at 0 m."""
    scaled = np.round((LEVELS - 1) * nearness(depth_mm, range_m))
    bytes_of: NDArray[np.uint8] = (1.0 + scaled).astype(np.uint8)
    bytes_of[depth_mm == 0] = 0
    return bytes_of


@cache
def palette() -> tuple[str, ...]:
    """Return the colour "#rrggbb" of each byte."""
    table = colormaps["viridis"](np.linspace(0.0, 1.0, LEVELS), bytes=True)[:, :3].tolist()
    return (NO_RETURN, *(f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in table))


def coloured(depth_mm: NDArray[np.uint16], range_m: float) -> NDArray[np.uint8]:
    """Return a depth image (h, w) [mm] in colour, RGB (h, w, 3)."""
    table = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in palette()], np.uint8)
    picture: NDArray[np.uint8] = table[shades(depth_mm, range_m)]
    return picture


def pictured(image: NDArray[Any], range_m: float) -> NDArray[np.uint8]:
    """Return a camera image (`camera.frame.Frame.image`) for display: RGB (h, w, 3)."""
    return rgb_of(image) if image.ndim == 3 else coloured(image, range_m)


INK = "#21262d"
"""Titles, labels, ticks."""
MUTED = "#68707a"
RULE = "#d5d9de"
"""Grid and axis lines."""
PAPER = "#fffffe"
"""Background; not pure white, so that the theme does not replace white elements."""
SERIES = "#2868a8"
SERIES_SOFT = "#a9c8e6"
MARK = "#b4540a"
"""Highlights: percentiles, phase limits."""

HALO = "#fffffd"
"""Outline of a drawn path, for contrast with the background."""

DARK = {
    INK: "#e4e7eb",
    MUTED: "#9aa3ad",
    RULE: "#3a4149",
    PAPER: "#181c20",
    SERIES: "#78b2ea",
    SERIES_SOFT: "#2f5378",
    MARK: "#f0a35a",
    HALO: "#98a1ab",
    FLOOR_COLOUR: "#23282e",
    GRID_COLOUR: "#31383f",
    START_COLOUR: "#6aa7e8",
    GOAL_COLOUR: "#45b36b",
    STATIC_COLOURS[0]: "#7f8a95",
}
"""Dark value of each light colour, including the arena picture's colours."""

PNG_DPI = 160
PNG_LEVEL = 3
"""Compression level of zlib, 1 to 9; level 6 takes 50 % longer for 10 % smaller files."""
SVG_DPI = 120
_PATH = re.compile(r'\b(?:d|x|y)="[^"]*"')
# Positions are rounded to 0.1 pt; the coordinates of small markers to 0.01 pt.
_DECIMALS = re.compile(r"(?<=\d)(\d\.\d)\d+|(\.\d\d)\d+")
_BITMAP = re.compile(r"(data:image/png;base64,)([A-Za-z0-9+/=\s]+)")
BITMAP_COLOURS = 128
"""Palette size of a bitmap in a figure; more colours add size without visible benefit."""
_SIZE = re.compile(r'<svg[^>]*? width="([\d.]+)pt" height="([\d.]+)pt"')
CSS_PX_PER_PT = 96.0 / 72.0
_FONT = re.compile(r"(font: [^;\"]*?px) [^;\"]*")


@dataclass(frozen=True)
class FigureImage:
    """Figure as SVG and PNG."""

    name: str
    alt: str
    """Alternative text for screen readers."""
    svg: str
    png: bytes

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [CSS px]; they reserve the picture's space while a page loads."""
        found = _SIZE.search(self.svg)
        if found is None:
            raise ValueError(f"{self.name}: an SVG without its width and height in points")
        width, height = (round(float(points) * CSS_PX_PER_PT) for points in found.groups())
        return width, height

    def data_uri(self) -> str:
        """Return the SVG for an `img` of a template."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg.encode()).decode()


LABEL_LEFT_IN = 0.04
"""Left edge of the labels of stacked axes [inch]."""


class Margins(NamedTuple):
    """Margins around and between the axes of a figure [inch]."""

    left: float
    right: float
    bottom: float
    top: float
    between: float


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure with the theme's background, independent of global state."""
    return _blank(width_in, height_in, "constrained")


def _blank(width_in: float, height_in: float, layout: Literal["constrained"] | None) -> Figure:
    figure = Figure(figsize=(width_in, height_in), facecolor=PAPER, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def stacked_axes(
    rows: int, width_in: float, height_in: float, margins: Margins, **options: Any
) -> tuple[Figure, NDArray[np.object_]]:
    """Return a figure with axes that share x; margins are fixed, as a layout is slow."""
    figure = _blank(width_in, height_in, None)
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False, **options)[:, 0]
    for ax in axes:
        # Fixed positions: automatic placement measures all ticks in each drawing.
        ax.set_title("", y=1.0)
        left_edge = blended_transform_factory(figure.dpi_scale_trans, ax.transAxes)
        ax.yaxis.set_label_coords(LABEL_LEFT_IN, 0.5, left_edge)
        ax.yaxis.label.set_va("top")
    inner = height_in - margins.bottom - margins.top - (rows - 1) * margins.between
    figure.subplots_adjust(
        left=margins.left / width_in,
        right=1.0 - margins.right / width_in,
        bottom=margins.bottom / height_in,
        top=1.0 - margins.top / height_in,
        hspace=margins.between * rows / inner,
    )
    return figure, axes


def share_grid(axes: Sequence[Axes]) -> None:
    """Draw a common vertical grid through stacked axes, faster than separate ticks."""
    lowest = axes[-1]
    low, high = lowest.get_xlim()
    ticks = [float(tick) for tick in lowest.get_xticks() if low <= tick <= high]
    for ax in axes[:-1]:
        ax.xaxis.set_visible(False)
        grid = LineCollection(
            [[(tick, 0.0), (tick, 1.0)] for tick in ticks],
            transform=ax.get_xaxis_transform(),
            colors=RULE,
            linewidths=GRID_WIDTH,
            zorder=GRID_ORDER,
        )
        ax.add_collection(grid, autolim=False)


_FILES: ContextVar[tuple[Path, tuple[str, ...]] | None] = ContextVar("figure files", default=None)


@contextmanager
def figure_files(folder: Path, formats: tuple[str, ...]) -> Iterator[None]:
    """Write every figure that is rendered in this context as files for print, too.

    Args:
        folder: Folder of the files, named after the figures.
        formats: Formats of matplotlib, such as `pdf`.
    """
    token = _FILES.set((folder, formats))
    try:
        yield
    finally:
        _FILES.reset(token)


def render(figure: Figure, name: str, alt: str) -> FigureImage:
    """Render a figure. The output is reproducible: no dates, no random identifiers."""
    png = render_png(figure)
    folder, formats = _FILES.get() or (Path(), ())
    for form in formats:
        metadata = {"CreationDate": None} if form == "pdf" else {"Date": None}
        with replacing(folder / f"{name}.{form}") as partial:
            figure.savefig(partial, format=form, metadata=metadata)
    svg = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(svg, format="svg", dpi=SVG_DPI, metadata={"Date": None, "Creator": None})
    return FigureImage(name, alt, themed(slim(svg.getvalue())), png)


def render_png(figure: Figure) -> bytes:
    """Render a figure as PNG in the light colours and fix its layout."""
    if (engine := figure.get_layout_engine()) is not None:
        # The layout costs more than the drawing, so PNG and SVG share one run.
        engine.execute(figure)
        # With any layout engine set, matplotlib draws every figure twice.
        figure.set_layout_engine(None)
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=PNG_DPI, pil_kwargs={"compress_level": PNG_LEVEL})
    return png.getvalue()


def slim(svg: str) -> str:
    """Return a smaller SVG with rounded coordinates and small bitmap palettes."""
    svg = _PATH.sub(lambda found: _DECIMALS.sub(r"\1\2", found[0]), svg)
    return _BITMAP.sub(lambda found: found[1] + _with_palette(found[2]), svg)


def _with_palette(encoded: str) -> str:
    """Return a base64 PNG reduced to a small palette."""
    small = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(encoded))) as image:
        few = image.convert("RGBA").quantize(BITMAP_COLOURS, method=Image.Quantize.FASTOCTREE)
        few.save(small, format="png", optimize=True)
    return base64.b64encode(small.getvalue()).decode()


def themed(svg: str) -> str:
    """Return an SVG with theme colours and font that follow the reader's setting."""
    light = "".join(f"--c{i}:{colour};" for i, colour in enumerate(DARK))
    dark = "".join(f"--c{i}:{colour};" for i, colour in enumerate(DARK.values()))
    query = "@media screen and (prefers-color-scheme:dark)"
    style = f"<style>svg{{{light}}}{query}{{svg{{{dark}}}}}</style>"
    for i, colour in enumerate(DARK):
        svg = svg.replace(colour, f"var(--c{i})")
    svg = _FONT.sub(r"\1 system-ui, sans-serif", svg)
    head = svg.index(">", svg.index("<svg")) + 1
    return svg[svg.index("<svg") : head] + style + svg[head:]


GRID_WIDTH = 0.6
GRID_ORDER = 0.5
"""Z-order of a matplotlib grid below the data."""


def plain_axes(ax: Axes, *, grid: bool = True) -> None:
    """Style axes: thin rules, small ticks, no box."""
    ax.set_facecolor("none")
    ax.tick_params(colors=MUTED, labelsize=8, length=0, which="both")
    for side, spine in ax.spines.items():
        spine.set_visible(grid and side == "bottom")
        spine.set_color(RULE)
    if grid:
        ax.grid(True, color=RULE, linewidth=GRID_WIDTH)
        ax.set_axisbelow(True)


def label_axes(ax: Axes, x: str = "", y: str = "", title: str = "") -> None:
    """Set the given labels and title of axes."""
    if x:
        ax.set_xlabel(x, fontsize=8.5, color=MUTED)
    if y:
        ax.set_ylabel(y, fontsize=8.5, color=MUTED)
    if title:
        ax.set_title(title, loc="left", y=1.0, fontsize=10.5, color=INK, pad=6)


def logarithmic(ax: Axes, axis: Literal["x", "y"]) -> None:
    """Make an axis logarithmic with plain numbers as labels."""
    ax.set(**{f"{axis}scale": "log"})
    shown = ax.xaxis if axis == "x" else ax.yaxis
    shown.set_major_formatter(StrMethodFormatter("{x:g}"))
    shown.set_minor_formatter(NullFormatter())


def legend_below(figure: Figure | SubFigure, columns: int = 3, **options: Any) -> None:
    """Add a legend below a figure."""
    look: dict[str, Any] = {"frameon": False, "fontsize": 8, "labelcolor": INK}
    figure.legend(loc="outside lower left", ncols=columns, **(look | options))


class LineStyle(NamedTuple):
    """Style of a line or bar in a series."""

    colour: str
    dashes: str
    """Line style of matplotlib; distinguishes lines in print without colour."""


LINE_COLOURS = (
    *("#2f7fc4", "#cf6a12", "#2c9a5b", "#a35bb8"),
    *("#c8435f", "#8d7b1c", "#1697a6", "#7d6b60"),
)
"""Line colours of medium lightness, legible on light and dark backgrounds."""

DASHES = ("-", "--", "-.", ":")


def line_style(index: int) -> LineStyle:
    """Return the style of the line with an index from 0; styles repeat after 32."""
    step = index // len(LINE_COLOURS)
    return LineStyle(LINE_COLOURS[index % len(LINE_COLOURS)], DASHES[(index + step) % len(DASHES)])


def montage(pictures: Sequence[FigureImage], columns: int) -> bytes:
    """Return a PNG with all pictures (one or more) in rows."""
    images = [Image.open(io.BytesIO(picture.png)).convert("RGB") for picture in pictures]
    rows = [images[start : start + columns] for start in range(0, len(images), columns)]
    width = max(sum(image.width for image in row) for row in rows)
    heights = [max(image.height for image in row) for row in rows]
    whole = Image.new("RGB", (width, sum(heights)), PAPER)
    for number, row in enumerate(rows):
        for place, image in enumerate(row):
            left = sum(before.width for before in row[:place])
            whole.paste(image, (left, sum(heights[:number])))
    png = io.BytesIO()
    whole.save(png, format="png")
    return png.getvalue()
