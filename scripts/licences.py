"""Licences of installed packages: exit code 1 if one needs a review.

python scripts/licences.py prints a table. A licence outside `ACCEPTED` needs an entry in
`REVIEWED`; libraries under the GPL inside wheels need an entry in NOTICE.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from importlib.metadata import Distribution, distributions
from pathlib import Path

NOTICE = Path(__file__).resolve().parents[1] / "NOTICE"

ACCEPTED = re.compile(
    r"(?i)^(mit|(3-clause )?bsd|(new|modified) bsd|apache|isc|python software|psf|zlib|unlicense"
    r"|mozilla public license|mpl|the unlicense|cc0|0bsd|hpnd|historical permission|public domain"
    r"|dfsg|\(?mit)"
)
"""Start of permissive licences, and of MPL 2.0: its files keep their licence."""

REVIEWED = {
    "apsw": "any licence of the Open Source Initiative, for example MIT",
    "cyclonedds": "EPL-2.0 or BSD-3-Clause, at the user's choice",
    "pymavlink": "LGPLv3: imported, not changed; named in NOTICE",
}
"""Packages with another or a missing licence, and the reason to accept them."""

GPL_LIBRARIES = ("x264", "x265", "postproc", "rubberband", "vidstab", "xvid")
"""GPL parts of FFmpeg builds, by their names in files of wheels."""


def licence_of(package: Distribution) -> str:
    """Return the licence in a package's metadata; empty if missing."""
    data = package.metadata.json
    if expression := data.get("license_expression"):
        return str(expression)
    found = [line.split(" :: ")[-1] for line in data.get("classifier", []) if "License ::" in line]
    return "; ".join(found) or str(data.get("license", "")).strip().split("\n")[0]


def problems_of(packages: Iterable[Distribution], notice: str) -> list[str]:
    """Return a line for each package that needs a review."""
    problems = []
    for package in packages:
        name, licence = package.name.lower(), licence_of(package)
        if not ACCEPTED.match(licence) and name not in REVIEWED:
            problems.append(
                f"{name}: licence {licence!r}; accepted: a review in scripts/licences.py"
            )
        files = [each.name for each in package.files or () if ".libs" in str(each)]
        bundled = {part for part in GPL_LIBRARIES for file in files if part in file}
        for part in sorted(bundled):
            if not re.search(rf"(?s)\b{name}\b.*\blib{part}\b", notice):
                problems.append(f"{name}: contains {part} (GPL); accepted: an entry in NOTICE")
    return problems


def main() -> int:
    """Print the licences; return 1 if a package needs a review."""
    packages = sorted(distributions(), key=lambda each: each.name.lower())
    for package in packages:
        print(f"{package.name} {package.version}: {licence_of(package)}")
    problems = problems_of(packages, NOTICE.read_text(encoding="utf-8"))
    print("\n".join(problems) or f"{len(packages)} packages: no licence needs a review")
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
