"""The picture of the live view in the documentation: a flight, paused, as Chromium shows it.

    python scripts/view_pictures.py        # writes docs/images/view.png

A rehearsal in lockstep flies with --view. A headless Chromium watches, pauses it in the middle of
the way to the goal, and takes the picture.
"""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.support.browser import Page, browser  # noqa: E402 (from here on the checkout is found)

PICTURE = ROOT / "docs" / "images" / "view.png"

FLIGHT = (
    *("--level", "lockstep", "--arena", "dynamic-obstacles", "--policy", "dynamic-obstacles"),
    *("--computer", "ras-pi-4", "--workload", "template-5x32", "--compensate"),
    *("--seed", "4", "--episodes", "1"),
)
PAUSE_S = 14.5
"""When the flight is paused [simulated s]."""

SIZE = (1280, 800)
COLOURS = 256
"""Of the picture's palette: more are not seen, and weigh."""

SETTLE_S = 4.0
"""What a browser that draws without a GPU needs to draw all [wall s]."""


def main() -> None:
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        printed = folder / "printed.txt"
        words = [sys.executable, "-m", "airl_mav.cli.sitl", *FLIGHT, "--view", "--out", "run"]
        with browser(folder) as page, printed.open("wb") as file:
            environment = {**os.environ, "PYTHONPATH": str(ROOT)}
            flight = subprocess.Popen(
                words, cwd=folder, env=environment, stdout=file, stderr=subprocess.STDOUT
            )
            try:
                page.resize(*SIZE)
                page.open(address(printed, flight))
                wait_until_flown(page, PAUSE_S)
                page.press("Pause")
                # It says that there is no GPU here.
                page.evaluate("document.querySelector('[role=alert] button')?.click()")
                time.sleep(SETTLE_S)
                picture = folder / "page.png"
                page.screenshot(picture)
            finally:
                flight.terminate()
                flight.wait()
        with Image.open(picture) as image:
            reduced = image.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
        data = io.BytesIO()
        reduced.save(data, "PNG", optimize=True)
        PICTURE.write_bytes(data.getvalue())
    print(f"{PICTURE}: {len(data.getvalue()) / 1000:.0f} kB")


def address(printed: Path, flight: subprocess.Popen[bytes]) -> str:
    """Return the address of the view, once it is printed."""
    while True:
        text = printed.read_text()
        if found := re.search(r"view +(http://\S+)", text):
            return found[1]
        assert flight.poll() is None, text
        time.sleep(0.1)


def wait_until_flown(page: Page, seconds: float) -> None:
    """Return when the page shows that so much of the flight is flown [simulated s]."""
    while True:
        told = re.search(r"^time\s+([\d.]+) s", page.text(), re.M)
        if told and float(told[1]) >= seconds:
            return
        time.sleep(0.05)


if __name__ == "__main__":
    main()
