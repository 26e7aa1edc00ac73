r"""Pictures of the report for the documentation, rendered by Chromium.

    airl evaluate static-obstacles --level lockstep --computer ras-pi-4 --workload template-5x32 \
        --episodes 20 --out RUN
    airl report RUN
    python scripts/report_pictures.py RUN    # writes docs/images/rehearsal.png and report.png

The first shows the first screen, the second the worst flight with commands and motion.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.support.browser import Page, browser  # noqa: E402 (from here on the checkout is found)

IMAGES = ROOT / "docs" / "images"

WIDTH, FIRST_HIGH, FLIGHT_HIGH = 1165, 720, 1560

WAIT_S = 120.0


def main() -> None:
    """Write the pictures of a run that has a report."""
    page_file = Path(sys.argv[1]).resolve() / "report.html"
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        browser(Path(folder)) as page,
    ):
        page.resize(WIDTH, FIRST_HIGH)
        page.open(page_file.as_uri())
        wait_until_drawn(page)
        page.screenshot(IMAGES / "rehearsal.png")
        page.resize(WIDTH, FLIGHT_HIGH)
        page.evaluate("document.getElementById('by-flight').scrollIntoView()")
        time.sleep(2.0)
        page.screenshot(IMAGES / "report.png")


def wait_until_drawn(page: Page) -> None:
    """Wait for the page's script; exit on timeout."""
    deadline = time.monotonic() + WAIT_S
    while not page.evaluate("performance.getEntriesByName('drawn').length"):
        if time.monotonic() > deadline:
            sys.exit("the page was not drawn")
        time.sleep(0.2)


if __name__ == "__main__":
    main()
