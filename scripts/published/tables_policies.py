"""Tables of the built-in policies, in their training arenas and in others."""

from __future__ import annotations

from pathlib import Path

from airl_mav.policy.registry import find_policy
from airl_mav.profiles.loading import load_published
from airl_mav.scenario.model import DEFAULT_POLICY
from published.blocks import Records, block
from published.record import FlownRun
from published.text import NONE, energy_kj, number, rate, table

# --- the built-in policies

SHIPPED: dict[str, tuple[str, str]] = {
    "generalist": ("generalist", "generalist-crowded"),
    "static-obstacles": ("generalisation", "static-obstacles-static-obstacles"),
    "static-obstacles-ppo": ("static-obstacles-ppo", "run"),
    "static-obstacles-fast": ("static-obstacles-fast", "run"),
    "static-obstacles-any-latency": ("any-latency", "static-obstacles-any-latency-1ms"),
    "static-obstacles-d435": ("static-obstacles-d435", "run"),
    "static-obstacles-rgb-fast": ("static-obstacles-rgb-fast", "run"),
    "static-obstacles-ras-pi-4": ("hardware-gap", "static-obstacles-mitigated"),
    "no-obstacles": ("generalisation", "no-obstacles-no-obstacles"),
    "dynamic-obstacles": ("generalisation", "dynamic-obstacles-dynamic-obstacles"),
    "dynamic-obstacles-fast": ("dynamic-obstacles-fast", "run"),
    "dense-obstacles": ("generalisation", "dense-obstacles-dense-obstacles"),
    "dense-obstacles-fast": ("dense-obstacles-fast", "run"),
    "dense-obstacles-d435": ("dense-obstacles-d435", "run"),
    "crowded": ("generalisation", "crowded-crowded"),
    "crowded-pipelined": ("crowded-pipelined", "run"),
    "crowded-fast": ("crowded-fast", "run"),
    "crowded-panorama": ("crowded-panorama", "run"),
    "gates": ("gates", "run"),
    "body-rates": ("body-rates-hardware-gap", "no-obstacles-reference"),
    "body-rates-120ms": ("body-rates-hardware-gap", "no-obstacles-mitigated"),
    "body-rates-hall": ("body-rates-hall", "run"),
}
"""Results of each policy in its training arena, at its training latency."""

RECORDS = tuple(dict.fromkeys(record for record, _ in SHIPPED.values()))
"""Records of these results."""

_MAKERS = {
    "dqn": "double DQN",
    "ppo": "PPO",
    "dagger": "DAgger",
    "monte-carlo": "Monte Carlo value",
}
_ACTIONS = {
    "arc-25": "arcs",
    "velocity": "continuous",
    "velocity3d-yaw-rate": "planner's candidates",
    "velocity3d-fixed-yaw": "continuous, with a climb",
    "body-rates": "body rates and thrust",
}


def _shipped(records: Records) -> list[tuple[str, FlownRun]]:
    return [(name, records[record].runs[run]) for name, (record, run) in SHIPPED.items()]


@block("policies", *RECORDS)
def policies(records: Records) -> str:
    rows = []
    for name, run in _shipped(records):
        card = find_policy(name).card
        assert card is not None
        maker = f"{_MAKERS[card.algorithm]}, {_ACTIONS[card.actions.set]}"
        late = f", t2 = {run.t2_ms:.0f} ms" if run.t2_ms and run.t2_ms > 10 else ""
        rows.append(
            (
                f"`{name}`" + (" (default)" if name == DEFAULT_POLICY else ""),
                maker,
                "frame" if card.decisions == "pipelined" else f"{card.hold_s:g} s",
                f"`{run.arena}`{late}",
                f"{rate(run)} %",
                f"{number(run.flight_time_s, 2)} s",
                f"{number(run.distance_m, 1)} m",
                f"{energy_kj(run)} kJ",
            )
        )
    heads = ("policy", "algorithm", "decides every", "flown in", "success", "time", "distance")
    return table((*heads, "energy"), rows)


# --- generalisation


@block("generalisation-paper", "generalisation")
def generalisation_paper(records: Records) -> str:
    arenas = ("no-obstacles", "static-obstacles", "dynamic-obstacles")
    runs, rows = records["generalisation"].runs, []
    for trained in ("no-obstacles", "dynamic-obstacles"):
        told = load_published().generalisation[trained]
        rows.append((trained, "the paper", *(f"{told[arena]:g}" for arena in arenas)))
        rows.append(("", "ours", *(rate(runs[f"{trained}-{arena}"]) for arena in arenas)))
    return table(("trained in", "", *arenas), rows, 3)


@block("policies-in-arenas", "policies-in-arenas")
def policies_in_arenas(records: Records) -> str:
    runs = records["policies-in-arenas"].runs.values()
    at = {(run.policy, run.arena): run.success_rate for run in runs}
    arenas = tuple(dict.fromkeys(run.arena for run in runs))
    rows = []
    for policy in dict.fromkeys(run.policy for run in runs):
        own = find_policy(policy).card
        trained = None if own is None else own.training.arena
        cells = [number(at[policy, arena], 1, scale=100.0) for arena in arenas]
        cells = [f"**{c}**" if a == trained else c for a, c in zip(arenas, cells, strict=True)]
        rows.append((f"`{policy}`" + (" (classical)" if own is None else ""), *cells))
    return table(("policy", *(Path(arena).stem for arena in arenas)), rows, len(arenas))


@block("generalist", "generalist")
def generalist(records: Records) -> str:
    rows = [
        (
            f"`{Path(run.arena).stem}`",
            f"{rate(run)} %",
            f"{number(run.flight_time_s, 2)} s",
            f"{number(run.distance_m, 1)} m",
            f"{energy_kj(run)} kJ",
        )
        for run in records["generalist"].runs.values()
    ]
    return table(("arena", "success", "time", "distance", "energy"), rows)


# --- without one input

_ZEROED = ("none", "velocity", "goal", "depth")
"""Runs of the ablation, by zeroed input; the paper calls the goal "position"."""

_LAYOUTS = {
    "no-obstacles": "paper-layout-no-obstacles",
    "static-obstacles": "paper-layout",
    "dynamic-obstacles": "paper-layout-dynamic-obstacles",
}
"""Policies with the paper's layout, by arena; policies with our layout have the arena's name."""


@block("ablation", "ablation")
def ablation(records: Records) -> str:
    runs, rows = records["ablation"].runs, []
    for arena, paper_layout in _LAYOUTS.items():
        told = load_published().ablation[arena]
        rows.append((arena, "the paper", *(_told(told.get(z)) for z in _ZEROED), ""))
        for layout, policy in (("body", arena), ("paper", paper_layout)):
            flown = [runs[f"{policy}-in-{arena}/{zeroed}"] for zeroed in _ZEROED]
            times = [number(run.flight_time_s, 2) for run in (flown[0], flown[2])]
            rows.append(
                ("", f"ours, layout `{layout}`", *map(rate, flown), f"{times[0]}, {times[1]} s")
            )
    heads = ("all inputs", "without velocity", "without position", "without depth")
    return table(("arena", "", *heads, "flight time: all, without position"), rows, 5)


def _told(success_percent: float | None) -> str:
    return NONE if success_percent is None else f"{success_percent:g}"


# --- goals beyond the training distance


@block("held-out-zone", "held-out-zone")
def held_out_zone(records: Records) -> str:
    runs, rows = records["held-out-zone"].runs, []
    learned = {"near": "within 32 m", "everywhere": "everywhere"}
    for zone in ("within", "beyond"):
        for name, goals in learned.items():
            run = runs[f"{zone}/{name}"]
            flown = number(run.flight_time_s, 2), number(run.distance_m, 1)
            rows.append((f"{zone} 32 m", goals, rate(run), *flown))
    heads = "goals flown to", "goals learned", "success [%]", "flight time [s]", "distance [m]"
    return table(heads, rows, 3)
