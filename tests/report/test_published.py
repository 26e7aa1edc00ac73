"""Published figures equal results/*.json, and are marked as outdated after code changes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import pytest

from airl_mav.addons.roofline import roofline as roofline_module
from airl_mav.core.errors import UsageError
from airl_mav.core.machine import provenance
from airl_mav.experiments.evaluate import evaluate
from airl_mav.experiments.experiment import rehearse
from airl_mav.flight.statistics import aggregate
from airl_mav.policy.card import load_card
from airl_mav.report.document import Column, TableView, write_table
from airl_mav.scenario.model import DEFAULT_POLICY, Scenario
from published import coverage, flying, pages, record, tables_policies
from published.behaviour import read_behaviour
from published.changes import Change, read_changes, stands
from published.collect import collect
from published.declared import Declared, read_declared
from published.record import Made, Record
from tests.support.processes import ROOT


@pytest.fixture(scope="module")
def records() -> dict[str, Record]:
    return record.all_records()


@pytest.mark.parametrize("page", pages.pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_are_written_from_the_results(page: Path, records: dict[str, Record]) -> None:
    """Run `make results-docs` if this fails."""
    text = page.read_text(encoding="utf-8")
    assert pages.rendered(text, records, page) == text


def test_cards_are_written_from_the_results(records: dict[str, Record]) -> None:
    assert [folder.name for folder, _ in pages.stale_cards(records)] == []
    for policy in record.shipped_policies():
        card = load_card(pages.POLICIES / policy)
        own = [each for each in card.results if each.arena == card.training.arena]
        assert own, policy
        assert all(each.success_low is not None for each in card.results), policy


def test_results_are_shown_and_every_table_of_figures_is_known(
    records: dict[str, Record],
) -> None:
    assert set(records) - pages.shown(records) == coverage.off_the_pages()
    assert coverage.unknown_tables() == []
    assert coverage.listed_in_vain() == []


def test_declared_results_are_there(records: dict[str, Record]) -> None:
    for name, declared in read_declared().items():
        assert records[name].runs or records[name].printed, name
        assert records[name].made.command == declared.command


# --- what is older says so


@pytest.fixture
def fresh(records: dict[str, Record]) -> Record:
    """Return a result of today's code, independent of all accepted changes."""
    made = {"behaviour": record.behaviour_today(), "policies": dict(record.shipped_policies())}
    gap = records["hardware-gap"]
    return gap.model_copy(update={"made": gap.made.model_copy(update=made)})


def test_an_older_behaviour_is_said_under_its_tables(
    records: dict[str, Record], fresh: Record
) -> None:
    today, records = fresh, {**records, "hardware-gap": fresh}
    older = today.model_copy(update={"made": today.made.model_copy(update={"behaviour": "0" * 16})})
    text = "<!-- results: mitigation-gaps -->\n<!-- end of results -->"
    assert "Flights have changed" not in pages.rendered(text, records, "page")
    said = pages.rendered(text, {**records, "hardware-gap": older}, "page")
    made = today.made
    flown = f"Flown on {made.date} with version {made.version}"
    assert f"**{flown}. Flights have changed since.**" in said
    # The figures are equal: only the text about them differs.
    again = pages.rendered(text, records, "page")
    assert said.split("`airl hardware-gap")[0] == again.split("`airl hardware-gap")[0]


def test_a_page_with_a_provenance_block_lists_its_commands_there(
    records: dict[str, Record], fresh: Record
) -> None:
    records = {**records, "hardware-gap": fresh}
    marks = "".join(
        f"<!-- results: {name} -->\n<!-- end of results -->\n"
        for name in ("mitigation-gaps", "mitigation-runs", "provenance")
    )
    tables, listed = pages.rendered(marks, records, "page").split("<!-- results: provenance -->")
    assert "airl " not in tables and tables.count("`results/hardware-gap.json`") == 2
    assert listed.count(f"`{fresh.made.command}` | {fresh.made.date}") == 1


def test_another_file_of_a_policy_is_out_of_date(fresh: Record) -> None:
    made = fresh.made.model_copy(update={"policies": {"static-obstacles": "0" * 64}})
    retrained = fresh.model_copy(update={"made": made})
    assert record.out_of_date(fresh) == ""
    assert "another file of `static-obstacles`" in record.out_of_date(retrained)


def test_results_without_a_fingerprint_are_marked(
    records: dict[str, Record], fresh: Record
) -> None:
    made = fresh.made.model_copy(update={"behaviour": None})
    without = [each for each in records.values() if each.made.behaviour is None]
    for each in (fresh.model_copy(update={"made": made}), *without):
        assert "Flights have changed since" in record.out_of_date(each)


# --- changes of which it is known what they touch

OLDER, OLD, TODAY = "0" * 16, "1" * 16, "2" * 16
MOVERS = Change(
    before=OLD,
    after=TODAY,
    why="movers",
    flights=("lockstep, crowded",),
    levels=("lockstep", "sitl"),
    arenas=("crowded",),
    untouched=("one-goal",),
)
WALLS = MOVERS.model_copy(update={"before": OLDER, "after": OLD, "arenas": ("walls",)})


@pytest.mark.parametrize(
    ("behaviour", "name", "flown", "expected"),
    [
        (TODAY, "x", [("lockstep", "crowded")], True),
        (OLD, "x", [("lockstep", "crowded")], False),
        (OLD, "x", [("gym", "crowded")], True),
        (OLD, "x", [("gym", "crowded"), ("sitl", "crowded")], False),
        (OLD, "x", [("lockstep", "walls")], True),
        (OLDER, "x", [("lockstep", "walls")], False),
        (OLDER, "x", [("lockstep", "crowded")], False),
        (OLDER, "x", [("lockstep", "dense")], True),
        (OLD, "one-goal", [], True),
        (OLD, "other", [], False),
        ("3" * 16, "x", [("gym", "dense")], False),
        (None, "x", [("gym", "dense")], False),
    ],
)
def test_a_result_stands_where_no_change_touches_it(
    behaviour: str | None, name: str, flown: list[tuple[str, str]], expected: bool
) -> None:
    changes = {each.before: each for each in (MOVERS, WALLS)}
    assert stands(behaviour, TODAY, changes, name, flown) is expected


def test_changes_that_lead_nowhere_end() -> None:
    back = WALLS.model_copy(update={"after": OLDER})
    assert not stands(OLDER, TODAY, {OLDER: back}, "x", [("gym", "dense")])


def test_the_changes_written_down_name_flights_that_are_flown_and_results_that_are_there(
    records: dict[str, Record],
) -> None:
    changes = read_changes(record.CHANGES_FILE)
    flown = read_behaviour(record.BEHAVIOUR_FILE).flights
    for change in changes.values():
        assert set(change.untouched) <= set(records)
        # A change may declare a larger effect than observed, never a smaller one.
        for name in change.flights:
            assert name in flown
            level, arena, *_ = name.split(", ")
            assert level in change.levels and arena in change.arenas
        assert not any(records[name].runs for name in change.untouched), "known by its runs"


# --- marks


@pytest.mark.parametrize(
    "text",
    [
        "<!-- results: mitigation-gaps -->",
        "<!-- results: no-such-block -->\n<!-- end of results -->",
        "a word <!-- results: mitigation-gaps -->\n<!-- end of results -->",
        "<!-- end of results -->",
    ],
)
def test_marks_that_cannot_be_written_are_refused(text: str, records: dict[str, Record]) -> None:
    with pytest.raises(UsageError, match="page"):
        pages.rendered(text, records, "page")


# --- flying


@pytest.fixture(autouse=True)
def _no_page(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    from airl_mav.report.comparison import show

    with monkeypatch.context() as patch:
        patch.setattr(show, "write_document", lambda made, folder: folder / f"{made.name}.html")
        yield


def declare(command: str, kind: str, **more: object) -> Declared:
    return Declared.model_validate(
        {"name": "x", "what": "a test", "command": command, "kind": kind, "minutes": 1, **more}
    )


def test_a_run_is_collected_as_it_was_flown(tmp_path: Path) -> None:
    run = rehearse(Scenario(level="gym", episodes=8, latency="150ms"), out=tmp_path / "run")
    found = collect(declare("airl evaluate", "run"), tmp_path / "run", "f" * 16)
    flown, rate = found.runs["run"], aggregate(run.episodes).success_rate
    assert (flown.policy, flown.arena, flown.latency) == (
        DEFAULT_POLICY,
        "static-obstacles",
        "150ms",
    )
    assert flown.success_rate.n == 8
    assert flown.success_rate.value == rate.value
    assert flown.success_rate.low == pytest.approx(rate.low)
    assert flown.t2_ms == pytest.approx(150.0)
    assert set(found.made.policies) == {DEFAULT_POLICY}
    assert found.made.behaviour == "f" * 16
    record.write_record(found, tmp_path)
    assert record.read_record("x", tmp_path) == found


def test_a_table_of_runs_is_collected_and_shown(tmp_path: Path) -> None:
    result = evaluate(
        Scenario(level="gym", episodes=6),
        ["greedy", "static-obstacles"],
        ["no-obstacles", "crowded"],
        out=tmp_path / "matrix",
    )
    found = collect(declare("airl evaluate", "matrix"), tmp_path / "matrix", None)
    assert list(found.runs) == list(result.runs)
    shown = tables_policies.policies_in_arenas({"policies-in-arenas": found})
    assert "| `greedy` (classical) |" in shown
    for name, run in result.runs.items():
        assert found.runs[name].success_rate.value == pytest.approx(run.quality.success_rate.value)
    with pytest.raises(UsageError, match="no hardware gap here"):
        collect(declare("airl hardware-gap", "hardware-gap"), tmp_path / "matrix", None)


def test_a_roofline_is_collected_as_a_table(tmp_path: Path) -> None:
    asked = roofline_module.RooflineRequest(
        computers=("workstation",), sensing_distance_m=8.0, draws=2
    )
    with patch.object(roofline_module, "write_document", lambda made, folder: folder):
        (tmp_path / "roofline").mkdir()
        (point,) = roofline_module.roofline(asked, out=tmp_path / "roofline").found.points
    found = collect(declare("airl roofline", "roofline"), tmp_path / "roofline", "f" * 16)
    assert found.printed is not None
    (row,) = found.printed.rows
    cells = dict(zip(found.printed.columns, row, strict=True))
    assert cells["measured"] == f"{point.measured_m_s:.2f} m/s"
    assert cells["binds"] == point.binds
    assert set(found.made.policies) == {"static-obstacles-fast"}
    assert found.made.behaviour == "f" * 16


def test_a_table_of_a_script_is_taken_with_its_pictures(tmp_path: Path) -> None:
    columns = (Column("what", number=False), Column("success", "%"))
    view = TableView("x", "A test", columns, (("late", "97.0 [95.0, 98.1]"),))
    made = provenance("python scripts/x.py")
    write_table(view, tmp_path / "out", made, (DEFAULT_POLICY, "mine"))
    declared = declare("python scripts/x.py", "table", pictures={"a.png": "docs/b.png"})
    (tmp_path / "docs").mkdir()
    with pytest.raises(UsageError, match=r"pictures: a.png"):
        flying.take_result(declared, tmp_path / "out", "f" * 16, tmp_path)
    (tmp_path / "out" / "a.png").write_bytes(b"picture")
    path = flying.take_result(declared, tmp_path / "out", "f" * 16, tmp_path)
    assert path == tmp_path / "results" / "x.json"
    assert (tmp_path / "docs" / "b.png").read_bytes() == b"picture"
    found = record.read_record("x", path.parent)
    assert found.printed is not None
    assert found.printed.columns == ("what", "success, %")
    assert found.printed.rows == view.rows
    assert found.made.date == made["created_utc"][:10]
    # Of the policies that flew only a shipped one can be known to have changed.
    assert set(found.made.policies) == {DEFAULT_POLICY}


@pytest.mark.nightly
def test_flying_writes_quick_results_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flying, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(flying, "RESULTS", tmp_path / "results")
    declared = declare(
        "airl evaluate greedy --episodes 50 --arena no-obstacles", "run", quick="--episodes 4"
    )
    path = flying.fly_result(declared, quick=True)
    assert path == tmp_path / "runs" / "quick" / "x.json"
    assert record.read_record("x", path.parent).runs["run"].success_rate.n == 4
    assert not (tmp_path / "results").exists()


def test_what_must_be_flown_again_is_known(tmp_path: Path, fresh: Record) -> None:
    declared = read_declared()["hardware-gap"]
    assert flying.why_out_of_date(declared, tmp_path) == "Not flown yet."
    record.write_record(fresh, tmp_path)
    assert flying.why_out_of_date(declared, tmp_path) == ""
    other = declared.model_copy(update={"command": "airl hardware-gap --episodes 7"})
    assert "another command" in flying.why_out_of_date(other, tmp_path)
    older: Made = fresh.made.model_copy(update={"behaviour": None})
    record.write_record(fresh.model_copy(update={"made": older}), tmp_path)
    assert "Flights have changed" in flying.why_out_of_date(declared, tmp_path)


def test_commands_of_other_programs_are_refused() -> None:
    with pytest.raises(UsageError, match="accepted: airl"):
        flying.fly_result(declare("rm -r x", "run"), quick=False)
