"""Verdict: setup, success rate, and each requirement as met, not met or undecided.

The verdict is the last line of a run's output. CI reads it from `verdict.json`, JUnit XML or a
badge.
"""

from __future__ import annotations

import math
import shlex
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from airl_mav.core import errors, files, machine
from airl_mav.flight.episode_record import EpisodeRecord, Setup
from airl_mav.flight.judge import BY_HAND, STRANGER, Outcome
from airl_mav.flight.requirements import Finding, Requirement, RequirementDecision, find
from airl_mav.flight.statistics import Aggregate, Estimate, PairedComparison, aggregate
from airl_mav.latency.injection import moments
from airl_mav.rehearsal.run_folder import LoadedRun, RunInfo
from airl_mav.report.document import environment
from airl_mav.scenario.model import SCENARIO_FILE

SCHEMA = 1
"""Schema version of `verdict.json`, described in docs/reference/run-folder.md."""

VERDICT_FILE = "verdict.json"

Status = Literal["invalid", "not met", "undecided", "met", "nothing required"]

EXIT_CODES: dict[Status, int] = {
    "invalid": errors.EXIT_INVALID,
    "not met": errors.EXIT_NOT_MET,
    "undecided": errors.EXIT_UNDECIDED,
    "met": 0,
    "nothing required": 0,
}

BADGE_COLOURS: dict[Status, str] = {
    "invalid": "#68707a",
    "not met": "#c0261c",
    "undecided": "#a86400",
    "met": "#1b8a3f",
    "nothing required": "#2f7fc4",
}


@dataclass(frozen=True)
class OverallVerdict:
    """Verdict on a run or a comparison."""

    sentences: tuple[str, ...]
    """Policy, machine and outcome of a run, with intervals."""
    short: str
    """Short form for a badge."""
    invalid: tuple[str, ...] = ()
    """Invalid flights, one line each; any of them makes the verdict invalid."""
    findings: tuple[Finding, ...] = ()
    advice: str = ""
    """Proposal for flights that the host disturbed; empty = no proposal."""
    schema: int = SCHEMA

    @property
    def status(self) -> Status:
        """Status: the worst of all findings."""
        decisions = {finding.decision for finding in self.findings}
        if self.invalid:
            return "invalid"
        if RequirementDecision.NOT_MET in decisions:
            return "not met"
        if RequirementDecision.UNDECIDED in decisions:
            return "undecided"
        return "met" if decisions else "nothing required"

    @property
    def exit_code(self) -> int:
        """Exit status of a command whose flights are complete."""
        return EXIT_CODES[self.status]

    @property
    def lines(self) -> tuple[str, ...]:
        """Lines of the verdict, most important first."""
        return (
            *(f"INVALID: {line}" for line in self.invalid),
            *filter(None, (self.advice,)),
            *self.sentences,
            *(finding.sentence() for finding in self.findings),
        )


def join_verdicts(parts: Sequence[OverallVerdict], short: str) -> OverallVerdict:
    """Return the verdict of several runs, which must all meet the requirements."""
    return OverallVerdict(
        sentences=tuple(sentence for part in parts for sentence in part.sentences),
        short=short if len(parts) != 1 else parts[0].short,
        invalid=tuple(line for part in parts for line in part.invalid),
        findings=tuple(finding for part in parts for finding in part.findings),
    )


def judge_run(
    setup: Setup,
    quality: Aggregate,
    episodes: Sequence[EpisodeRecord],
    requirements: Sequence[Requirement] = (),
    against: PairedComparison | None = None,
    reference: str = "",
) -> OverallVerdict:
    """Return the verdict of a run; raise FieldError for a required gap without a reference."""
    computer = Path(setup.computer.name).stem
    rate, injection = quality.success_rate, setup.injection
    machine = computer
    if injection.latency is not None:
        machine += f" with {moments(injection.latency)} of {injection.origin} latency"
    conditions = f" ({setup.conditions})" if setup.conditions else ""
    firmware = "".join(f", {name}" for name in {each.firmware: 0 for each in episodes} if name)
    sentence = (
        f"{setup.policy.name} on {machine} in {Path(setup.arena.name).stem}{conditions},"
        f" level {setup.level}{firmware}: {_reached(rate, episodes)}"
    )
    if against is not None:
        sentence += _gap_words(against, reference)
    share = "no valid flight" if rate.value is None else f"{100.0 * rate.value:.1f} %"
    return OverallVerdict(
        sentences=(f"{sentence}.",),
        short=f"{share} on {machine}",
        invalid=invalid_flights(episodes),
        findings=tuple(find(requirement, quality, against) for requirement in requirements),
    )


def _reached(rate: Estimate, episodes: Sequence[EpisodeRecord]) -> str:
    """Return the outcome of all flights as text."""
    told = []
    if rate.value is not None:
        goals = f"{round(rate.value * rate.n):,} of {rate.n:,} goals reached"
        told.append(f"{goals}, {_percent(rate.scaled(100.0))}")
    if invalid := [episode for episode in episodes if episode.invalid]:
        successes = sum(episode.outcome is Outcome.SUCCESS for episode in invalid)
        flights = "flight" if len(invalid) == 1 else "flights"
        told.append(
            f"{len(invalid):,} {flights} flown but invalid ({successes:,} reached the goal)"
        )
    return "; ".join(told) or "no flight was finished"


def invalid_flights(episodes: Sequence[EpisodeRecord]) -> tuple[str, ...]:
    """Return a line for each invalid flight."""
    return tuple(
        f"flight {episode.index:03d}, seed {episode.seed}: {'; '.join(episode.invalid)}"
        for episode in episodes
        if episode.invalid
    )


def unchecked(runs: Iterable[RunInfo]) -> tuple[str, ...]:
    """Return a note if any run has validity checks disabled; otherwise, an empty tuple."""
    if all(run.config.get("validity", True) for run in runs):
        return ()
    return ("Whether the host kept pace was not checked: every flight counts.",)


def _gap_words(against: PairedComparison, reference: str) -> str:
    rate, time = against.success_rate.difference, against.flight_time_s.difference
    told = []
    if rate.value is not None:
        word = "fewer" if rate.value < 0.0 else "more"
        told.append(f"{abs(rate.value):.1f} points {word}{_interval(rate)}")
    if time.value is not None:
        word = "less" if time.value < 0.0 else "more"
        told.append(f"a median {abs(time.value):.1f} % {word} flight time{_interval(time)}")
    return f"; {' and '.join(told)} than {reference}" if told else ""


def _percent(estimate: Estimate) -> str:
    value = f"{estimate.value:.1f} %"
    if estimate.low is None or estimate.high is None:
        return value
    return f"{value} [{estimate.low:.1f}, {estimate.high:.1f}]"


def _interval(difference: Estimate) -> str:
    if difference.low is None or difference.high is None:
        return ""
    return f" [{difference.low:+.1f}, {difference.high:+.1f}]"


# --- files


_VERDICT: TypeAdapter[OverallVerdict] = TypeAdapter(OverallVerdict)


def save_verdict(verdict: OverallVerdict, folder: Path) -> None:
    """Write `verdict.json`, including status and exit code, atomically."""
    data = _VERDICT.dump_python(verdict, mode="json")
    extra = {"status": verdict.status, "exit_code": verdict.exit_code}
    files.write_json(folder / VERDICT_FILE, {**data, **extra})


def load_verdict(folder: Path) -> OverallVerdict:
    """Read the verdict of a folder. Raises UsageError."""
    return files.read_typed(folder / VERDICT_FILE, _VERDICT, SCHEMA, "verdict")


def requirements_of(folder: Path) -> tuple[Requirement, ...]:
    """Return the requirements of a folder's last verdict; empty without a verdict."""
    if not (folder / VERDICT_FILE).exists():
        return ()
    return tuple(dict.fromkeys(f.requirement for f in load_verdict(folder).findings))


def write_junit(verdict: OverallVerdict, path: Path, suite: str) -> None:
    """Write a verdict as JUnit XML, with a case in `suite` for validity and each requirement."""
    cases = len(verdict.findings) + 1
    failures = sum(finding.decision is not RequirementDecision.MET for finding in verdict.findings)
    counts = {
        "tests": str(cases),
        "failures": str(failures),
        "errors": str(int(verdict.status == "invalid")),
    }
    root = ET.Element("testsuites", counts)
    part = ET.SubElement(root, "testsuite", {"name": suite, **counts})
    valid = ET.SubElement(part, "testcase", {"classname": suite, "name": "valid flights"})
    if verdict.invalid:
        problem = ET.SubElement(valid, "error", {"type": "invalid", "message": verdict.invalid[0]})
        problem.text = "\n".join(verdict.invalid)
    for finding in verdict.findings:
        case = ET.SubElement(
            part, "testcase", {"classname": suite, "name": str(finding.requirement)}
        )
        if finding.decision is not RequirementDecision.MET:
            kind = "not met" if finding.decision is RequirementDecision.NOT_MET else "undecided"
            failure = ET.SubElement(case, "failure", {"type": kind, "message": finding.sentence()})
            failure.text = "\n".join(verdict.sentences)
    ET.SubElement(part, "system-out").text = "\n".join(verdict.lines)
    ET.indent(root)
    files.replace_file(path, ET.tostring(root, encoding="utf-8", xml_declaration=True))


GLYPH_PX = 6.6
"""Mean width of a character of Verdana at 11 px; `textLength` makes the text fit exactly."""


def write_badge(verdict: OverallVerdict, path: Path) -> None:
    """Write an SVG badge with the short verdict in the colour of its status."""
    left, right = "rehearsal", verdict.short
    if verdict.status != "nothing required":
        right = f"{right}: {verdict.status}"
    widths = [math.ceil(GLYPH_PX * len(text)) + 10 for text in (left, right)]
    svg = (
        environment()
        .get_template("badge.svg.j2")
        .render(
            left=left,
            right=right,
            left_px=widths[0],
            right_px=widths[1],
            colour=BADGE_COLOURS[verdict.status],
        )
    )
    files.replace_file(path, svg.encode())


def verdict_of(run: LoadedRun, requirements: Sequence[Requirement] | None = None) -> OverallVerdict:
    """Return a run's verdict; `requirements` default to the requirements of `verdict.json`."""
    if requirements is None:
        requirements = requirements_of(run.path)
    setup, episodes = run.info.setup, run.episodes
    verdict = judge_run(setup, aggregate(episodes), episodes, requirements)
    reasons = [reason for episode in episodes for reason in episode.invalid]
    advice = "".join(unchecked([run.info]))
    if setup.level == "sitl" and any(not each.startswith((BY_HAND, STRANGER)) for each in reasons):
        file = shlex.quote(str(run.path / SCENARIO_FILE))
        advice = f"To fly without real time, run: airl-sitl {file} --level lockstep"
    sentences = verdict.sentences + machine.mixed_code(each.code for each in episodes)
    return replace(verdict, sentences=sentences, advice=advice)
