"""Pictures of the live view for the documentation, rendered by Chromium.

    python scripts/view_pictures.py        # writes docs/images/view.png and view.gif

Rehearsals in lockstep fly with --view, and a headless Chromium shows them. The picture pauses a
flight halfway to the goal. The film's flight is slow, because a browser without a GPU draws only
some frames a second. There the latency is set to 400 ms in the view, and compensated later.
"""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.support.browser import Page, browser  # noqa: E402 (from here on the checkout is found)

IMAGES = ROOT / "docs" / "images"

FLIGHT = (
    *("--level", "lockstep", "--arena", "dynamic-obstacles", "--policy", "dynamic-obstacles"),
    *("--seed", "4", "--episodes", "1"),
)
LATE = ("--computer", "ras-pi-4", "--workload", "template-5x32", "--compensate")

PAUSE_S = 14.5
"""Pause time of the picture's flight [simulated s]."""

SIZE = (1280, 800)
COLOURS = 256
"""Palette size of the picture: more colours are invisible, and increase the file."""

SETTLE_S = 4.0
"""Time for a browser without a GPU to draw all [wall s]."""

SLOWLY = 0.15
"""Speed of the film's flight [simulated s per wall s]."""

FILM_SIZE, FILM_WIDTH, FILM_COLOURS = (1060, 880), 600, 64
"""Size of the page, and width and colours of the film."""

FROM_S, LATE_S, COMPENSATED_S, TO_S = 11.2, 12.2, 15.2, 19.5
"""Times of the film's start, the latency setting, the compensation and the film's end."""

FRAME_S = 0.14
"""Minimum time between two frames [simulated s]."""


def main() -> None:
    with page_of((*FLIGHT, *LATE), SIZE) as page:
        wait_until_flown(page, PAUSE_S)
        page.press("Pause")
        time.sleep(SETTLE_S)
        image = shot(page)
    reduced = image.quantize(COLOURS, dither=Image.Dither.NONE)
    data = io.BytesIO()
    reduced.save(data, "PNG", optimize=True)
    save("view.png", data)
    with page_of((*FLIGHT, "--speed", str(SLOWLY)), FILM_SIZE) as page:
        save("view.gif", film(page))


def film(page: Page) -> io.BytesIO:
    """Return the film, with each frame's duration from the flight."""
    wait_until_flown(page, FROM_S)
    due = {LATE_S: "Set t2 by hand", COMPENSATED_S: "Compensate"}
    frames: list[Image.Image] = []
    times: list[float] = []
    while not times or times[-1] < TO_S:
        now_s = seconds(page)
        for at_s in [at_s for at_s in due if at_s <= now_s]:
            page.tick(due.pop(at_s))
        if times and now_s < times[-1] + FRAME_S:
            continue
        image = shot(page)
        height = round(FILM_WIDTH * image.height / image.width)
        frames.append(image.resize((FILM_WIDTH, height), Image.Resampling.LANCZOS))
        times.append(now_s)
    palette = frames[len(frames) // 2].quantize(FILM_COLOURS, dither=Image.Dither.NONE)
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    lasts = [round(1e3 * (b - a)) for a, b in pairwise(times)]
    data = io.BytesIO()
    first, *rest = small
    first.save(
        data, "GIF", save_all=True, append_images=rest, duration=[*lasts, 2000], loop=0, disposal=1
    )
    return data


@contextmanager
def page_of(words: tuple[str, ...], size: tuple[int, int]) -> Iterator[Page]:
    """Fly a rehearsal for the context's duration and yield the page that shows it."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        printed = folder / "printed.txt"
        command = [
            sys.executable,
            "-m",
            "airl_mav.cli.sitl_command",
            *words,
            "--view",
            "--out",
            "run",
        ]
        with browser(folder) as page, printed.open("wb") as file:
            environment = {**os.environ, "PYTHONPATH": str(ROOT)}
            flight = subprocess.Popen(
                command, cwd=folder, env=environment, stdout=file, stderr=subprocess.STDOUT
            )
            try:
                page.resize(*size)
                page.open(address(printed, flight))
                while not page.press("Go on"):
                    time.sleep(0.2)
                time.sleep(SETTLE_S)
                # Dismisses the note on the missing GPU.
                page.evaluate("document.querySelector('[role=alert] button')?.click()")
                yield page
            finally:
                flight.terminate()
                flight.wait()


def address(printed: Path, flight: subprocess.Popen[bytes]) -> str:
    """Return the address of the view, once it is printed."""
    while True:
        text = printed.read_text()
        if found := re.search(r"view +(http://\S+)", text):
            return found[1]
        assert flight.poll() is None, text
        time.sleep(0.1)


def seconds(page: Page) -> float:
    """Return the flown time shown by the page [simulated s]."""
    told = re.search(r"^time\s+([\d.]+) s", page.text(), re.M)
    return float(told[1]) if told else 0.0


def wait_until_flown(page: Page, flown_s: float) -> None:
    """Wait until this much of the flight is flown [simulated s]."""
    while seconds(page) < flown_s:
        time.sleep(0.05)


def shot(page: Page) -> Image.Image:
    """Return the current screenshot."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "page.png"
        page.screenshot(path)
        return Image.open(path).convert("RGB")


def save(name: str, data: io.BytesIO) -> None:
    """Write an image of the documentation."""
    path = IMAGES / name
    path.write_bytes(data.getvalue())
    print(f"{path.relative_to(ROOT)}: {len(data.getvalue()) / 1000:.0f} kB")


if __name__ == "__main__":
    main()
