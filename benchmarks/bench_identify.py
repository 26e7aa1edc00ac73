"""Accuracy of identifications, on flights with known parameters.

    .venv/bin/python benchmarks/bench_identify.py [--flights 20] [--keep FOLDER] [--rehearsals 4]

Flies aircraft in lockstep with mass, thrust, drag, link, latency and wind that differ from the
profile. The companion's black box and the vehicle's log record the flights. Identifies each from
both, the black box alone and the log alone, and prints the errors. 20 flights take about two
minutes. With --rehearsals each is flown again with its identified profiles, together and one by
one: a minute or two more for each.

The true dead time is from the same model on the simulator's path, starting when the flight
controller took each setpoint. No recording contains this time.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from airl_mav.addons.identification.identify import identify
from airl_mav.addons.identification.rehearse_flight import (
    PartFlown,
    Rehearsals,
    rehearse_flight_parts,
)
from airl_mav.scenario.model import DEFAULT_ARENA
from tests.support.identify_truths import (
    IdentificationErrors,
    drawn_truth,
    errors_of,
    true_dead_time_s,
)
from tests.support.recorded_flights import RecordedFlight

BOTH, BOX, LOG = "both", "box", "log"
"""Sources of an identification: black box and vehicle's log, or only one."""

ASKED = {"dead_s": 0.008, "mass": 0.03, "wind_m_s": 0.5, "t2": 0.02}
"""Required accuracy."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--first", type=int, default=1, help="seed of the first flight")
    parser.add_argument("--keep", type=Path, help="keep the recordings in this folder")
    parser.add_argument("--rehearsals", type=int, default=0, help="of each flight")
    asked = parser.parse_args()
    parts: dict[str, list[PartFlown]] = {}
    rows: dict[str, list[IdentificationErrors]] = {BOTH: [], BOX: [], LOG: []}
    print("seed  from  dead ms  lag %  mass %  drag %  wind m/s  t2 %")
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(asked.first, asked.first + asked.flights):
            truth = drawn_truth(seed)
            folder = (asked.keep or Path(scratch)) / f"{seed:03d}"
            flight = truth.fly(folder)
            true_s = true_dead_time_s(flight)
            found = {
                BOTH: identify(flight.black_box, ulg=flight.ulg),
                BOX: identify(flight.black_box),
                LOG: identify(flight.ulg),
            }
            if asked.rehearsals:
                _rehearse(flight, folder / "again", asked.rehearsals, parts)
            for title, each in found.items():
                errors = errors_of(each, truth, true_s, flight)
                rows[title].append(errors)
                print(f"{seed:4d}  {title:5s}{_row(errors)}  {flight.reason}")
    for title, errors_of_all in rows.items():
        print(f"\nfrom {title}:")
        for name, bound in ASKED.items():
            _summary(name, bound, errors_of_all)
    for part, flown in parts.items():
        apart_m = [each.apart_m for each in flown]
        shares = np.abs([each.time_share for each in flown if each.time_share is not None])
        print(
            f"rehearsed with {part}: time off by {np.median(shares):.2%} (median), by 2 % or less"
            f" in {int((shares <= 0.02).sum())} of {len(flown)}; path {np.median(apart_m):.2f} m"
            f" apart (median), {max(apart_m):.2f} m at most"
        )


def _rehearse(
    flight: RecordedFlight, folder: Path, episodes: int, parts: dict[str, list[PartFlown]]
) -> None:
    """Fly again on the identification, and keep the figures of each part."""
    out = folder / "identified"
    identify(flight.black_box, ulg=flight.ulg, out=out)
    asked = Rehearsals(arena=DEFAULT_ARENA, episodes=episodes)
    _, flown = rehearse_flight_parts(flight.black_box, folder / "flown", out, asked)
    for each in flown:
        parts.setdefault(each.part, []).append(each)


def _row(errors: IdentificationErrors) -> str:
    def cell(value: float | None, width: int, scale: float, digits: int) -> str:
        return f"{'-':>{width}s}" if value is None else f"{scale * value:{width}.{digits}f}"

    return "".join(
        (
            cell(errors.dead_s, 8, 1e3, 1),
            cell(errors.lag, 7, 100.0, 1),
            cell(errors.mass, 8, 100.0, 2),
            cell(errors.drag, 8, 100.0, 1),
            cell(errors.wind_m_s, 10, 1.0, 2),
            cell(errors.t2, 7, 100.0, 2),
        )
    )


def _summary(name: str, bound: float, rows: list[IdentificationErrors]) -> None:
    known = [(getattr(row, name), row.inside.get(name)) for row in rows]
    values = np.abs([value for value, _ in known if value is not None])
    inside = [within for value, within in known if value is not None and within is not None]
    if not len(values):
        print(f"  {name}: observed in no flight")
        return
    print(
        f"  {name}: observed in {len(values)} of {len(rows)}; error median {np.median(values):.4f},"
        f" greatest {values.max():.4f}; within {bound:g} in {int((values <= bound).sum())};"
        f" 95 % interval holds the truth in {sum(inside)} of {len(inside)}"
    )


if __name__ == "__main__":
    main()
