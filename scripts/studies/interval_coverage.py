"""Coverage of the printed intervals, by simulation, and power of the comparison of two policies.

    python scripts/studies/interval_coverage.py [coverage|comparison] [--draws N] [--out DIR]

`coverage`: share of samples whose 95 % interval contains the true value, for flight times of
several distributions, flown flight times drawn again with replacement, and success rates.
`comparison`: pairs until `airl verdict --against` decides, and its decisions, beside tests of a
fixed number of pairs. It calls the product's functions. Writes table.json, which results.py
publishes.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy import stats

from airl_mav.core.machine import provenance
from airl_mav.core.progress import new_console
from airl_mav.experiments.experiment import rehearse
from airl_mav.flight.requirements import LOOKS, InterimAnalysis, RateTest, plan_looks
from airl_mav.flight.statistics import (
    Agreement,
    Estimate,
    anytime_gap,
    anytime_mean,
    common_successes,
    median_of,
    pair_by_seed,
    tango,
    wilson,
)
from airl_mav.report.document import Column, TableView, print_table, write_table
from airl_mav.scenario.model import Scenario

Floats = NDArray[np.float64]
Draw = Callable[[np.random.Generator, tuple[int, int]], Floats]

SIZES = (10, 30, 100, 1000)
POLICY, LATE = "static-obstacles", {"computer": "ras-pi-4", "workload": "template-5x32"}
EARLY = {"computer": "workstation", "workload": "template-5x32"}
SEED = 20_210_409


@dataclass(frozen=True)
class Command:
    """Simulate intervals."""

    table: tyro.conf.Positional[Literal["coverage", "comparison"]] = "coverage"

    draws: int = 20_000
    """Samples of each cell."""

    flights: int = 1000
    """Flights on each computer, whose times are drawn again."""

    out: Path = Path("runs/interval-coverage")
    """Folder of the flights and of table.json."""


def long_flights(share: float, rng: np.random.Generator, shape: tuple[int, int]) -> Floats:
    """Return times of 8 s with a share of flights that take 60 to 120 s."""
    usual = rng.lognormal(np.log(8.0), 0.2, shape)
    return np.where(rng.random(shape) < share, rng.uniform(60.0, 120.0, shape), usual)


def two_routes(share: float, rng: np.random.Generator, shape: tuple[int, int]) -> Floats:
    """Return times around 8 s, with a share around 12 s."""
    return np.where(rng.random(shape) < share, 12.0, 8.0) + rng.normal(0.0, 0.3, shape)


def again(values: Floats, rng: np.random.Generator, shape: tuple[int, int]) -> Floats:
    """Return values drawn again with replacement."""
    return rng.choice(values, shape)


def flown(flights: int, out: Path) -> tuple[Floats, Floats]:
    """Fly a policy early and late; return its late times [s] and the pairs' differences [%]."""
    early, late = (
        rehearse(
            Scenario(policy=POLICY, level="gym", episodes=flights, **conditions),
            out=out / conditions["computer"],
        ).episodes
        for conditions in (EARLY, LATE)
    )
    pairs = common_successes(pair_by_seed(early, late))
    first, second = np.array([(a.flight_time_s, b.flight_time_s) for a, b in pairs]).T
    return second, 100.0 * (second / first - 1.0)


def share_of(inside: NDArray[np.bool_] | list[bool]) -> str:
    return f"{100.0 * float(np.mean(inside)):.1f}"


def covers(found: Estimate, truth: float) -> bool:
    return found.low is not None and found.high is not None and found.low <= truth <= found.high


def of_medians(draw: Draw, truth: float, draws: int) -> list[str]:
    rng = np.random.default_rng(SEED)
    return [share_of([covers(median_of(x), truth) for x in draw(rng, (draws, n))]) for n in SIZES]


def of_means(draw: Draw, truth: float, draws: int) -> list[str]:
    """Return the coverage of Student's interval of the mean, which the product does not print."""
    rng, cells = np.random.default_rng(SEED), []
    for n in SIZES:
        values = draw(rng, (draws, n))
        half = stats.t.ppf(0.975, n - 1) * values.std(axis=1, ddof=1) / np.sqrt(n)
        cells.append(share_of(np.abs(values.mean(axis=1) - truth) <= half))
    return cells


def of_times(flights: int, draws: int, out: Path) -> list[tuple[str, ...]]:
    times, percent = flown(flights, out)
    logs = np.log(times)
    shape = (times.mean() / times.std()) ** 2
    kinds: dict[str, Draw] = {
        "log-normal as flown": lambda r, s: r.lognormal(logs.mean(), logs.std(), s),
        "gamma as flown": lambda r, s: r.gamma(shape, times.mean() / shape, s),
        "5 s and an exponential tail": lambda r, s: 5.0 + r.exponential(3.0, s),
        "0.5 % take 60 to 120 s": partial(long_flights, 0.005),
        "1 % take 60 to 120 s": partial(long_flights, 0.01),
        "two routes, 60 and 40 %": partial(two_routes, 0.4),
        "two routes, half each": partial(two_routes, 0.5),
        f"flown on the Raspberry Pi 4 ({times.size})": partial(again, times),
    }
    rows = []
    for name, draw in kinds.items():
        # The true median to 0.1 % of the spread; exact for flown times.
        many = times if name.startswith("flown") else draw(np.random.default_rng(0), (1, 4_000_001))
        rows.append(("median of times", name, *of_medians(draw, float(np.median(many)), draws), ""))
        if name.startswith(("0.5 %", "flown")):
            rows.append(("*mean (Student)*", name, *of_means(draw, float(many.mean()), draws), ""))
    flown_pairs = of_medians(partial(again, percent), float(np.median(percent)), draws)
    rows.append(("median of pairs", f"flown differences ({percent.size})", *flown_pairs, ""))
    return rows


def of_rates() -> list[tuple[str, ...]]:
    """Return exact sums: the average and the lowest over the rates from 50 to 99 %."""
    rates, lows, means = np.linspace(0.5, 0.99, 491), [], []
    for n in SIZES:
        ends = [wilson(k, n) for k in range(n + 1)]
        inside = np.array([[covers(end, rate) for rate in rates] for end in ends])
        chance = stats.binom.pmf(np.arange(n + 1)[:, None], n, rates)
        covered = (inside * chance).sum(axis=0)
        means.append(f"{100.0 * covered.mean():.1f}")
        lows.append(f"{100.0 * covered.min():.1f}")
    kinds = ("rates of 50 to 99 %, average", *means, ""), ("the same, lowest", *lows, "")
    return [("success rate (Wilson)", *cells) for cells in kinds]


def of_gaps(draws: int) -> list[tuple[str, ...]]:
    """Return the average coverage over 16 shares of gained and lost goals."""
    rng, by_tango, stopped = np.random.default_rng(SEED), [], []
    shares = [(gain, loss) for gain in (0.02, 0.05, 0.1, 0.2) for loss in (0.02, 0.05, 0.1, 0.2)]
    for n in SIZES:
        inside = []
        for gain, loss in shares:
            tables = rng.multinomial(n, [gain, loss, 1.0 - gain - loss], draws // len(shares))
            found = cache(lambda g, lost, n=n: tango(g, lost, n))
            inside += [covers(found(int(g), int(lost)), gain - loss) for g, lost, _ in tables]
        by_tango.append(share_of(inside))
    looks = [look for look in LOOKS if look <= 500]
    found = cache(lambda g, lost, n: anytime_gap(Agreement(n - g - lost, lost, g, 0)))
    for gain, loss in shares:
        steps = np.diff([0, *looks])
        parts = [
            rng.multinomial(k, [gain, loss, 1.0 - gain - loss], draws // (4 * len(shares)))
            for k in steps
        ]
        for path in np.cumsum(parts, axis=0).transpose(1, 0, 2):
            stopped.append(
                all(
                    covers(found(int(g), int(lost), n), 100.0 * (gain - loss))
                    for n, (g, lost, _) in zip(looks, path, strict=True)
                )
            )
    return [
        ("success gap (Tango)", "1 to 40 % of pairs differ, average", *by_tango, ""),
        (
            "success gap (betting)",
            "the same, at every look up to 500 pairs",
            *("",) * 4,
            share_of(stopped),
        ),
    ]


def of_misses(draws: int) -> list[tuple[str, ...]]:
    """Return the coverage of the mean of deadline misses, zero in nine of ten flights."""
    rng, cells = np.random.default_rng(SEED), []
    kinds, chances = np.array([0.0, 0.1, 0.5]), [0.9, 0.08, 0.02]
    found = cache(lambda counts: anytime_mean(kinds, counts))
    for n in SIZES:
        tables = rng.multinomial(n, chances, draws)
        truth = float(kinds @ chances)
        cells.append(share_of([covers(found(tuple(map(int, row))), truth) for row in tables]))
    return [("mean of deadline misses (betting)", "a tenth of the flights has some", *cells, "")]


def of_verdicts(draws: int) -> list[tuple[str, ...]]:
    """Return the lowest coverage at the stop of a test against 95 %, over true rates."""
    test, covered = RateTest(0.95), []
    steps = [look for look in LOOKS if look <= 500]
    for rate in (0.8, 0.85, 0.9, 0.92, 0.94, 0.95, 0.96, 0.98):
        rng = np.random.default_rng(SEED)
        known: dict[tuple[int, int], Estimate] = {}
        both = []
        for flights in rng.random((draws, 500)) < rate:
            failed = np.cumsum(~flights)
            look, k = next(
                (n, int(failed[n - 1]))
                for n in steps
                if n == steps[-1] or decides(test, n, int(failed[n - 1]))
            )
            if (look, k) not in known:
                known[look, k] = test.estimate([bool(each) for each in flights])
            both.append((covers(known[look, k], rate), covers(wilson(look - k, look), rate)))
        covered.append(np.mean(both, axis=0))
    mine, theirs = (f"{100.0 * each:.1f}" for each in np.min(covered, axis=0))
    name = "after `airl verdict` on 95 %, rates of 80 to 98 %, lowest"
    blank = ("",) * len(SIZES)
    return [
        ("success rate (stagewise)", name, *blank, mine),
        ("*success rate (Wilson)*", "the same", *blank, theirs),
    ]


@cache
def decides(test: RateTest, flights: int, failures: int) -> bool:
    """Return True if a number of failures decides at a look."""
    (look,) = (each for each in planned(test) if each.flights == flights)
    return not look.few < failures < look.many


@cache
def planned(test: RateTest) -> tuple[InterimAnalysis, ...]:
    return tuple(plan_looks(test.threshold, [look for look in LOOKS if look <= 500]))


def coverage(asked: Command) -> TableView:
    rows = [
        *of_times(asked.flights, asked.draws, asked.out),
        *of_rates(),
        *of_gaps(asked.draws),
        *of_misses(asked.draws // 4),
        *of_verdicts(asked.draws // 2),
    ]
    columns = (
        Column("interval", number=False),
        Column("data", number=False),
        *(Column(f"n = {n:,}") for n in SIZES),
        Column("at the stop"),
    )
    return TableView("coverage", "Coverage of 95 % intervals", columns, tuple(rows))


def comparison(asked: Command) -> TableView:
    """Return decisions of `airl verdict --against` and of a fixed number of pairs."""
    draws, most, rows = asked.draws // 5, 1000, []
    looks = np.array([look for look in LOOKS if look <= most])
    # Ties do not matter for zero: the decision depends on the discordant pairs alone.
    excludes = cache(lambda g, lost: (anytime_gap(Agreement(0, lost, g, 0)).low or -1.0) > 0.0)
    fixed = cache(lambda g, lost, n: (tango(g, lost, n).low or -1.0) > 0.0)
    for gain, loss in ((0.03, 0.03), (0.1, 0.1), (0.06, 0.02), (0.1, 0.05), (0.15, 0.05), (0.2, 0)):
        rng = np.random.default_rng(SEED)
        chances = [gain, loss, 1.0 - gain - loss]
        parts = [rng.multinomial(k, chances, draws) for k in np.diff([0, *looks])]
        paths = np.cumsum(parts, axis=0).transpose(1, 0, 2)
        better = worse = 0
        pairs = np.full(draws, most)
        for number, path in enumerate(paths):
            for n, (g, lost, _) in zip(looks, path, strict=True):
                if excludes(int(g), int(lost)) or excludes(int(lost), int(g)):
                    better += bool(g > lost)
                    worse += bool(g < lost)
                    pairs[number] = n
                    break
        at_end = [fixed(int(g), int(lost), most) for g, lost, _ in paths[:, -1]]
        needed = "-"
        if (d := gain - loss) > 0.0:
            both = gain + loss
            roots = 1.96 * np.sqrt(both) + 0.84 * np.sqrt(both - d * d)
            needed = f"{(roots / d) ** 2:.0f}"
        rows.append(
            (
                f"{100.0 * d:+.0f}",
                f"{100.0 * (gain + loss):.0f}",
                f"{100.0 * better / draws:.1f}",
                f"{100.0 * worse / draws:.1f}",
                f"{np.mean(pairs):.0f}",
                share_of(at_end),
                needed,
            )
        )
    columns = (
        Column("true gap", "points"),
        Column("pairs that differ", "%"),
        Column("decided better", "%"),
        Column("decided worse", "%"),
        Column("pairs flown, mean"),
        Column(f"fixed {most:,} pairs: better", "%"),
        Column("fixed pairs for 80 %"),
    )
    return TableView("comparison", "Two policies, up to 1,000 pairs", columns, tuple(rows))


def main(words: list[str] | None = None) -> int:
    """Simulate a table, print it and write it."""
    words = sys.argv[1:] if words is None else words
    asked = tyro.cli(Command, args=words, description=__doc__)
    view = {"coverage": coverage, "comparison": comparison}[asked.table](asked)
    print_table(view, new_console())
    command = shlex.join(["python", "scripts/studies/interval_coverage.py", *words])
    flies = [POLICY] if asked.table == "coverage" else []
    write_table(view, asked.out, provenance(command), flies)
    return 0


if __name__ == "__main__":
    sys.exit(main())
