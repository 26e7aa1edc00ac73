"""What a study found: a document, and the figures as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from airl_mav.core.files import write_json
from airl_mav.report.document import Document, write_document

SCHEMA = 1
"""Version of `study.json`; docs/how-to/studies.md describes it."""

DATA_FILE = "study.json"


@dataclass(frozen=True)
class Findings:
    """Everything that a study says."""

    key: str
    document: Document
    data: Mapping[str, Any] = field(default_factory=dict)
    """The figures, for `study.json`."""


def write_findings(findings: Findings, folder: Path, command: str) -> Path:
    """Write `study.json`, `study.md`, `study.html` and the PNG files; return the page's path.

    Args:
        findings: What is written.
        folder: Where to.
        command: How it was made.
    """
    data = {"schema": SCHEMA, "study": findings.key, "command": command, **findings.data}
    write_json(folder / DATA_FILE, data)
    return write_document(findings.document, folder)
