"""Long comparisons of scripts/: after a kill and a restart, they resume from stored flights."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import flown_lines
import honest_flights
import plants_compared
import pytest

from airl_mav.core.errors import UsageError
from airl_mav.core.files import read_json
from companion.limits import OUT_OF_BOUNDS, Ending
from published.record import behaviour_today

PAIR = plants_compared.Pair("crowded", 1, ("success", "success"), (400, 400), 3e-09, 0.25)


def test_a_line_that_was_cut_off_is_flown_again(tmp_path: Path) -> None:
    path = tmp_path / "new" / "flights.csv"
    lines = flown_lines.FlownLines(path, ("seed", "note"))
    lines.add({"seed": 1, "note": "out of bounds: 3, 4"})
    lines.add({"seed": 2, "note": ""})
    whole = path.read_text()
    path.write_text(f"{whole}3,out o")
    again = flown_lines.FlownLines(path, ("seed", "note"))
    assert again.rows == lines.rows
    assert path.read_text() == whole
    with pytest.raises(UsageError, match=r"columns seed,note; accepted: seed,other"):
        flown_lines.FlownLines(path, ("seed", "other"))


def test_pairs_of_plants_are_not_flown_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flown: list[int] = []

    def compared(arena: str, policy: str, seed: int) -> plants_compared.Pair:
        flown.append(seed)
        return replace(PAIR, seed=seed, apart_mm=2.0 if seed == 2 else 3e-09)

    monkeypatch.setattr(plants_compared, "compared", compared)
    words = ["--arenas", "crowded", "--out", str(tmp_path / "pairs.csv"), "--flights"]
    assert plants_compared.main([*words, "1"]) == 0
    assert plants_compared.main([*words, "3"]) == 1, "the second pair parts"
    assert flown == [1, 2, 3]
    assert plants_compared.main([*words, "3"]) == 1, "as it did then"
    assert flown == [1, 2, 3]
    rows = list(csv.DictReader((tmp_path / "pairs.csv").read_text().splitlines()))
    assert [plants_compared.pair_of(row).seed for row in rows] == [1, 2, 3]
    assert plants_compared.pair_of(rows[0]) == PAIR
    assert "parted" in capsys.readouterr().out


def test_false_alarms_are_counted_and_flights_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first flight is flown; that a limit was broken in the others is made up."""
    made_up = iter(("success", "collision", "aborted"))
    broken = str(Ending(OUT_OF_BOUNDS, "far"))

    setups = honest_flights.SETUPS
    flown = honest_flights.honest(setups[0], 1, behaviour_today())
    assert (flown.outcome, flown.alarm) == ("success", "")
    assert flown.decisions > 5

    def another(setup: honest_flights.Setup, seed: int, behaviour: str) -> honest_flights.Honest:
        changes = {**setup._asdict(), "seed": seed, "outcome": next(made_up), "alarm": broken}
        return replace(flown, **changes)

    lines = flown_lines.FlownLines(tmp_path / "flights.csv", honest_flights.COLUMNS)
    lines.add(honest_flights.row_of(flown))
    monkeypatch.setattr(honest_flights, "honest", another)
    assert honest_flights.main(["--flights", "4", "--out", str(tmp_path)]) == 0
    assert honest_flights.main(["--flights", "4", "--out", str(tmp_path)]) == 0
    table = read_json(tmp_path / "table.json", 1, "table")
    *_, last = table["rows"]
    assert last[:2] == ["all", "4"]
    assert last[3] == "2", "one after a collision is none"
    other = replace(flown, seed=9, behaviour="f" * 16)
    flown_lines.FlownLines(tmp_path / "flights.csv", honest_flights.COLUMNS).add(
        honest_flights.row_of(other)
    )
    with pytest.raises(UsageError, match="another behaviour"):
        honest_flights.main(["--flights", "4", "--out", str(tmp_path)])


def test_every_limit_is_an_alarm() -> None:
    from companion import limits

    told = {
        value for name, value in vars(limits).items() if name.isupper() and isinstance(value, str)
    }
    assert set(limits.REASONS) == told
