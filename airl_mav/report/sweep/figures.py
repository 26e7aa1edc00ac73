"""The figures of a sweep: success over the grid, cost over the grid, one against the other."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from airl_mav.report.figures import quiet
from airl_mav.report.heatmap import Field, HeatMap, draw_heat_map
from airl_mav.report.palette import look
from airl_mav.report.sweep.tables import count, percent, t2_ms
from airl_mav.report.theme import INK, MARK, MUTED, PAPER, Picture, new_figure, render, render_png
from airl_mav.sweep.summary import Cell, Sweep

TRADE_SIZE_IN = (7.4, 4.2)
ASIDE = 1.03
"""Factor between the dots of one network in two arenas."""
MARKERS = ("o", "s", "^", "D", "v")
LABELLED = 20
"""So many cells get their name in the trade-off; of more, only the best of each arena."""


def success_figure(sweep: Sweep, arena: str) -> Picture:
    """Draw the mean success rate of each cell of an arena, with its standard deviation."""
    heat = success_map(sweep, arena)
    figure = new_figure(*heat.size_in)
    draw_heat_map(figure, heat)
    told = ", ".join(
        f"{cell.network} {percent(cell.success_rate.value)} %"
        for cell in sweep.of(arena)
        if cell.success_rate.value is not None
    )
    return render(figure, f"sweep-{arena}", f"Success by layers and filters in {arena}: {told}")


def size_figure(sweep: Sweep, arena: str) -> Picture:
    """Draw multiply-accumulates and parameters of each cell, or its estimated latency."""
    heat = size_map(sweep, arena)
    figure = new_figure(*heat.size_in)
    draw_heat_map(figure, heat)
    alt = f"{heat.title} by layers and filters, {arena}"
    return render(figure, f"sweep-size-{arena}", alt)


def sheet(sweep: Sweep) -> bytes:
    """Draw success and size of all arenas and the trade-off on one sheet; return the PNG."""
    maps = [(success_map(sweep, arena), size_map(sweep, arena)) for arena in sweep.arenas]
    heights = [max(left.size_in[1], right.size_in[1]) for left, right in maps]
    width = max(left.size_in[0] + right.size_in[0] for left, right in maps)
    width = max(width, TRADE_SIZE_IN[0])
    heights.append(TRADE_SIZE_IN[1])
    figure = new_figure(width, sum(heights))
    rows = np.ravel(figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights))
    for row, pair in zip(rows, maps, strict=False):
        row.set_facecolor(PAPER)
        for part, heat in zip(np.ravel(row.subfigures(1, 2, squeeze=False)), pair, strict=True):
            part.set_facecolor(PAPER)
            draw_heat_map(part, heat)
    rows[-1].set_facecolor(PAPER)
    _draw_trade(rows[-1], sweep)
    return render_png(figure)


def success_map(sweep: Sweep, arena: str) -> HeatMap:
    """Return the success rates of an arena as a heat map."""
    best = sweep.best(arena)
    rates = [c.success_rate.value for c in sweep.of(arena) if c.success_rate.value is not None]
    low = 10.0 * math.floor(10.0 * min(rates, default=0.0))
    fields = {
        (cell.layers, cell.filters): Field(
            100.0 * cell.success_rate.value,
            _success_text(cell),
            marked=best is not None and cell.network == best.network,
        )
        for cell in sweep.of(arena)
        if cell.success_rate.value is not None
    }
    return _map(
        sweep,
        arena,
        title=arena,
        fields=fields,
        unit="success [%]",
        limits=(min(low, 90.0), 100.0),
        note="success, mean ± std over training seeds [%]",
    )


def _success_text(cell: Cell) -> str:
    assert cell.success_rate.value is not None  # noqa: S101 (only such are drawn)
    text = percent(cell.success_rate.value)
    if cell.success_std is not None:
        text += f"\n± {percent(cell.success_std)}"
    elif len(cell.results) < cell.planned:
        text += f"\n{len(cell.results)} of {cell.planned}"
    return text


def size_map(sweep: Sweep, arena: str) -> HeatMap:
    """Return what each network costs: multiply-accumulates, or the latency estimated from them."""
    cells = sweep.of(arena)
    timed = sweep.computer is not None
    values = [_cost(sweep, cell) for cell in cells]
    fields = {
        (cell.layers, cell.filters): Field(
            value,
            f"{t2_ms(value)} ms\n{count(cell.macs)} MAC"
            if timed
            else f"{count(cell.macs)} MAC\n{count(cell.parameters)} par.",
        )
        for cell, value in zip(cells, values, strict=True)
    }
    name = sweep.computer.name if sweep.computer is not None else ""
    return _map(
        sweep,
        arena,
        title=f"t2 on {name}, estimated" if timed else "size",
        fields=fields,
        unit="t2, estimated [ms]" if timed else "multiply-accumulates",
        limits=(min(values), max(max(values), 1.01 * min(values))),
        note=f"{'from multiply-accumulates' if timed else 'multiply-accumulates, parameters'}",
        logarithmic=True,
    )


def _map(
    sweep: Sweep,
    arena: str,
    *,
    title: str,
    fields: dict[tuple[int, int], Field],
    unit: str,
    limits: tuple[float, float],
    note: str,
    logarithmic: bool = False,
) -> HeatMap:
    grid = next(grid for grid in sweep.config.grids if grid.name == arena)
    return HeatMap(
        title=title,
        rows=grid.layers,
        row_title="layers",
        columns=grid.filters,
        column_title="filters",
        fields=fields,
        unit=unit,
        limits=limits,
        logarithmic=logarithmic,
        note=note,
    )


def trade_figure(sweep: Sweep) -> Picture:
    """Draw success against cost: estimated latency, or multiply-accumulates."""
    figure = new_figure(*TRADE_SIZE_IN)
    _draw_trade(figure, sweep)
    return render(figure, "sweep-trade-off", f"Success against {_cost_title(sweep)}, all networks")


def _cost(sweep: Sweep, cell: Cell) -> float:
    return cell.t2_ms if sweep.computer is not None and cell.t2_ms is not None else cell.macs


def _cost_title(sweep: Sweep) -> str:
    if sweep.computer is None:
        return "multiply-accumulates of an inference"
    return f"t2 on {sweep.computer.name}, estimated from multiply-accumulates [ms]"


def _draw_trade(figure: Figure | SubFigure, sweep: Sweep) -> None:
    """Draw a dot with its interval for each cell, a look for each arena."""
    ax = figure.subplots()
    known = {arena: [c for c in sweep.of(arena) if c.results] for arena in sweep.arenas}
    many = sum(map(len, known.values())) > LABELLED
    for i, (arena, cells) in enumerate(known.items()):
        if not cells:
            continue
        style, best = look(i), sweep.best(arena)
        for cell in cells:
            rate = cell.success_rate
            assert rate.value is not None and rate.low is not None and rate.high is not None  # noqa: S101
            # Networks of the same size in several arenas, side by side.
            x, chosen = _cost(sweep, cell) * ASIDE ** (i - (len(known) - 1) / 2), cell is best
            ax.plot(
                [x, x],
                [100.0 * rate.low, 100.0 * rate.high],
                color=style.colour,
                lw=1.2,
                alpha=0.55,
            )
            ax.plot(
                x,
                100.0 * rate.value,
                MARKERS[i % len(MARKERS)],
                ms=8 if chosen else 6,
                color=style.colour,
                mec=MARK if chosen else PAPER,
                mew=1.8 if chosen else 0.8,
                label=arena if cell is cells[0] else None,
                zorder=3,
            )
            if chosen or not many:
                ax.annotate(
                    cell.network,
                    (x, 100.0 * rate.value),
                    xytext=(8, 6 * (len(known) > 1) * (1 - i)),
                    textcoords="offset points",
                    va="center",
                    fontsize=8,
                    color=INK,
                    zorder=4,
                )
    ax.set_xscale("log")
    # Every 1, 2 and 5 has its number: a grid spans hardly more than a decade.
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(
        FuncFormatter(lambda v, _: f"{v:g}" if sweep.computer is not None else count(v))
    )
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel(_cost_title(sweep), fontsize=8.5, color=MUTED)
    ax.set_ylabel("success [%], 95 % interval", fontsize=8.5, color=MUTED)
    ax.set_title("What success costs", loc="left", fontsize=10.5, color=INK, pad=6)
    ax.set_ylim(top=101.5)
    quiet(ax)
    if len(sweep.arenas) > 1:
        ax.legend(frameon=False, fontsize=8.5, labelcolor=INK, loc="lower right")
