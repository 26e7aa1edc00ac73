"""What the documents of all kinds of comparison share."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from airl_mav.rehearsal.run_folder import LoadedRun
from airl_mav.report.comparison.model import Comparison
from airl_mav.report.document import Document, Facts, Section, provenance_facts, run_link


def comparison_document(
    comparison: Comparison,
    runs: Mapping[str, LoadedRun],
    folder: Path,
    *,
    kicker: str,
    sections: Sequence[Section],
    facts: Facts,
    lead: str = "",
    facts_title: str = "What flew",
) -> Document:
    """Return the document of a comparison; its parts are those of `Document`.

    Args:
        comparison: What is shown.
        runs: Its runs by name.
        folder: Where the document goes: links to the runs start there.
        kicker: Kind of the document; the date is added.
        sections: What it says.
        facts: What was flown.
        lead: One sentence under the title.
        facts_title: Heading of the facts.
    """
    first = comparison.runs[0]
    made = runs[first.name].info
    created = made.created_utc.replace("T", " ").replace("+00:00", " UTC")
    version = made.versions.get("airl-mav", "")
    several = len(comparison.groups) > 1
    return Document(
        name=comparison.kind,
        title=comparison.title,
        kicker=f"{kicker} · {created}",
        lead=lead,
        answers=comparison.answers,
        sections=tuple(sections),
        facts=facts,
        facts_title=facts_title,
        remarks=tuple(comparison.facts.get("remarks") or ()),
        runs=tuple(
            run_link(
                f"{Path(run.entry.group).stem}: {run.heading}" if several else run.heading,
                runs[run.name].path,
                folder,
            )
            for run in comparison.runs
        ),
        provenance=provenance_facts(made.machine, made.git, made.versions),
        configurations=((first.heading, json.dumps(made.config, indent=2, ensure_ascii=False)),),
        footer=(
            f"airl-mav {version} · machine, versions and configuration: those of {first.heading}; "
            f"figures as data in {comparison.kind}.json, tables in {comparison.kind}.md beside "
            "this page"
        ),
    )
