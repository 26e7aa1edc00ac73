"""The page of an architecture search: the networks of each arena, and what they cost."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial

from airl_mav.report.document import Document, Facts, Headline, Section, provenance_facts
from airl_mav.report.table import NONE
from airl_mav.report.theme import Picture
from airl_mav.sweep.pictures import cost_picture, success_picture, trade_picture
from airl_mav.sweep.store import SWEEP_FILE, as_data
from airl_mav.sweep.summary import Sweep, published_best
from airl_mav.sweep.tables import interval, networks_table, percent
from airl_mav.sweep.trial import training_of, trials


def document_of(sweep: Sweep) -> Document:
    """Return everything that a sweep says; at least one trial has ended."""
    sections = [
        Section(
            arena,
            sentences=best_sentences(sweep, arena),
            tables=(networks_table(sweep, arena),),
            draw=partial(_arena_pictures, sweep, arena),
        )
        for arena in sweep.arenas
    ]
    trade = Section("Success against cost", draw=lambda: [trade_picture(sweep)], in_terminal=False)
    made = sweep.made
    begun = f"{made['created_utc']}".replace("T", " ").replace("+00:00", " UTC")
    return Document(
        name="sweep",
        title=sweep.config.description,
        kicker=f"Architecture search · begun {begun} · {sweep.ended} of {sweep.planned} trials",
        lead="Templates of L convolutions x F filters, and as many dense layers of as many units.",
        headlines=tuple(_headline(sweep, arena) for arena in sweep.arenas),
        sections=(*sections, trade),
        facts=sweep_facts(sweep),
        facts_title="What was searched",
        provenance=(
            ("command", f"{made['command']}"),
            *provenance_facts(made["machine"], made["git"], made["versions"]),
        ),
        configurations=(
            ("the sweep", json.dumps(as_data(sweep.config), indent=2, ensure_ascii=False)),
        ),
        footer=(
            f"airl-mav {made['versions'].get('airl-mav', '')} · figures as data in {SWEEP_FILE} "
            "beside this page; a trial's policy flies with airl-sitl --policy "
            "trials/<trial>/policy"
        ),
    )


def _arena_pictures(sweep: Sweep, arena: str) -> list[Picture]:
    return [success_picture(sweep, arena), cost_picture(sweep, arena)]


def best_sentences(sweep: Sweep, arena: str) -> tuple[str, ...]:
    """Return which network was best in an arena, how sure that is, and the published one."""
    best, published = sweep.best(arena), published_best(arena)
    if best is None:
        return ("No trial has ended yet.",)
    n = best.success_rate.n
    seeds = "1 training seed" if n == 1 else f"{n} training seeds"
    lines = [
        f"Best: {best.network} with {percent(best.success_rate.value)} % "
        f"({interval(best)} %, {seeds}, {sum(r.episodes for r in best.results):,} flights)."
    ]
    known = [cell for cell in sweep.of(arena) if cell.results]
    if rivals := sweep.rivals(arena):
        told = ", ".join(cell.network for cell in rivals)
        lines.append(
            f"Within its interval, too: {told} ({len(rivals)} of {len(known) - 1}). The best of "
            "many is also the luckiest: its own figure flatters it."
        )
    if published is not None:
        lines.append(f"The paper's best: {published[0]} with {100.0 * published[1]:.0f} %.")
    return tuple(lines)


def sweep_facts(sweep: Sweep) -> Facts:
    """Return what was searched and how."""
    config = sweep.config
    training = training_of(config, trials(config)[0])
    environment, judged = training.environment, config.evaluation
    networks = (
        f"{grid.name}: layers {_listed(grid.layers)}, filters {_listed(grid.filters)}"
        for grid in config.grids
    )
    last = judged.seed + judged.episodes - 1
    rows = [
        ("what", config.description),
        ("trials", f"{sweep.ended} of {sweep.planned} ended"),
        ("networks", "; ".join(networks)),
        ("training seeds", _listed(config.seeds)),
        ("training", f"{training.algorithm.name}, {training.steps:,} decisions each"),
        (
            "image",
            f"{environment.image_width_px}x{environment.image_height_px} px, "
            f"layout {environment.layout}, actions {environment.actions}",
        ),
        (
            "judged by",
            f"{judged.episodes:,} flights each, seeds {judged.seed} to {last}, level gym",
        ),
    ]
    if sweep.computer is not None:
        rows.append(("computer", f"{sweep.computer.name} – {sweep.computer.profile.description}"))
    return tuple(rows)


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(f"{number}" for number in numbers)


def _headline(sweep: Sweep, arena: str) -> Headline:
    best, published = sweep.best(arena), published_best(arena)
    theirs = ""
    if published is not None:
        theirs = f"; the paper: {published[0]}, {100.0 * published[1]:.0f} %"
    if best is None:
        return Headline(arena, NONE, "", f"no trial has ended{theirs}")
    detail = f"{percent(best.success_rate.value)} % ({interval(best)}){theirs}"
    return Headline(arena, best.network, "", detail)
