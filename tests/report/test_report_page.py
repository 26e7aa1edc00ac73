"""The page of a run in a real browser: nothing fails, the view in three dimensions is there."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.run_folder import load
from airl_mav.report.run_page import build_page
from tests.support.run_demo import write_demo_run

CHROMIUM = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    None,
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here"),
    pytest.mark.xdist_group("chromium"),
]

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--hide-scrollbars",
    "--enable-unsafe-swiftshader",
    "--virtual-time-budget=60000",
    "--enable-logging=stderr",
)

WATCH = """<script>
window.seen = [];
// Frames by the clock that the test moves, not by the screen's.
window.requestAnimationFrame = (act) => setTimeout(() => act(performance.now()), 50);
// What is drawn would be gone before it could be looked at.
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  return getContext.call(this, kind, { ...options, preserveDrawingBuffer: true });
};
addEventListener("error", (event) => seen.push(`${event.message}`));
addEventListener("unhandledrejection", (event) => seen.push(`${event.reason}`));
</script>
"""

PROBE = """<script>
addEventListener("load", () => setTimeout(() => {
  const report = { errors: seen, width: document.documentElement.scrollWidth, window: innerWidth };
  const box = document.getElementById("scene");
  const finish = () => {
    // All that the page asked for beside itself.
    report.asked = performance.getEntriesByType("resource").map((entry) => entry.name)
      .filter((name) => !name.startsWith("data:") && !name.startsWith("blob:"));
    const out = document.createElement("pre");
    out.id = "probe";
    out.textContent = JSON.stringify(report);
    document.body.append(out);
  };
  report.live = box.classList.contains("live");
  report.missing = getComputedStyle(box.querySelector(".scene-missing")).display;
  if (!report.live) return finish();
  const [plot, pick, slider] = ["scene-plot", "scene-flight", "scene-time"]
    .map((id) => document.getElementById(id));
  report.flights = [...pick.options].map((option) => option.value);
  const frame = async (name) => {
    await new Promise((done) => setTimeout(done, 300));
    const drawn = plot.querySelector(".gl-container canvas") || plot.querySelector("canvas");
    const canvas = new OffscreenCanvas(400, 300);
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(drawn, 0, 0, 400, 300);
    const pixels = context.getImageData(0, 0, 400, 300).data;
    let sum = 0;
    const colours = new Set();
    for (let i = 0; i < pixels.length; i += 4) {
      sum = (sum * 31 + pixels[i] + 7 * pixels[i + 1] + 13 * pixels[i + 2]) % 1000003;
      colours.add((pixels[i] << 16) | (pixels[i + 1] << 8) | pixels[i + 2]);
    }
    report.frames[name] = { sum, colours: colours.size, shown: box.dataset.shown };
  };
  const choose = (value) => { pick.value = value; pick.dispatchEvent(new Event("change")); };
  (async () => {
    report.frames = {};
    await frame("first");
    await frame("again");
    slider.value = slider.min; slider.dispatchEvent(new Event("input")); await frame("begin");
    report.clock = document.getElementById("scene-clock").textContent;
    choose("1"); await frame("other");
    choose("3"); await frame("all");
    await Plotly.relayout(plot, plot.layout.updatemenus[0].buttons[1].args[0]);
    await frame("above");
    report.end = true;
    finish();
  })();
}, 500));
</script>
"""


def chromium(*arguments: str) -> subprocess.CompletedProcess[str]:
    assert CHROMIUM is not None
    return subprocess.run(
        [CHROMIUM, *FLAGS, *arguments], capture_output=True, text=True, timeout=120, check=False
    )


def probe(page: Path, *arguments: str) -> tuple[dict[str, Any], list[str]]:
    """Open a page that looks at itself; return what it found, and what the console said."""
    text = page.read_text(encoding="utf-8")
    spy = page.with_name("probe.html")
    spied = text.replace("<style>", WATCH + "<style>", 1).replace("</body>", PROBE + "</body>")
    spy.write_text(spied, encoding="utf-8")
    found = chromium("--dump-dom", *arguments, spy.as_uri())
    told = re.search(r'<pre id="probe">(.*?)</pre>', found.stdout, re.DOTALL)
    assert told, found.stderr[-2000:]
    console = [
        line
        for line in found.stderr.splitlines()
        if ":CONSOLE:" in line
        # Hints on speed, from the driver and from the library's own canvas.
        and not re.search("GL Driver Message|Multiple readback operations", line)
    ]
    return json.loads(html.unescape(told[1])), console


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, arenas = write_demo_run(
        tmp_path_factory.mktemp("page") / "demo", episodes=3, profile="dynamic-obstacles"
    )
    return build_page(load(folder.path), arenas, vehicle=load_vehicle("quad"))


def test_nothing_fails_nothing_is_asked_for_and_the_view_moves(page: Path) -> None:
    found, console = probe(page, "--window-size=1200,2000")
    assert found["errors"] == []
    assert console == []
    assert found["asked"] == []
    assert found["live"]
    assert found["missing"] == "none"
    assert found["flights"] == ["0", "1", "2", "3"]
    assert found["end"]
    frames = found["frames"]
    # Floor, walls, obstacles in their shades, a path in the colours of its speed.
    assert all(frame["colours"] > 30 for frame in frames.values()), frames
    assert frames["again"]["sum"] == frames["first"]["sum"]
    assert (frames["first"]["shown"], frames["all"]["shown"]) == ("0", "3")
    sums = [frames[name]["sum"] for name in ("first", "begin", "other", "all", "above")]
    assert len(set(sums)) == len(sums)
    assert re.fullmatch(r"-?\d+\.\d s · \d+\.\d m/s", found["clock"])


def test_a_phone_scrolls_down_and_not_sideways(page: Path) -> None:
    found, _ = probe(page, "--window-size=390,844")
    assert found["window"] <= 500
    assert found["width"] <= found["window"]


def test_without_webgl_the_page_says_so(page: Path) -> None:
    found, console = probe(page, "--disable-3d-apis", "--window-size=1200,2000")
    assert found["errors"] == []
    assert console == []
    assert not found["live"]
    assert found["missing"] == "block"


def test_light_and_dark_differ_and_paper_is_light(page: Path, tmp_path: Path) -> None:
    means = {}
    for name, extra in (
        ("light", ()),
        ("dark", ("--force-dark-mode", "--blink-settings=preferredColorScheme=0")),
    ):
        shot = tmp_path / f"{name}.png"
        chromium(f"--screenshot={shot}", "--window-size=1000,1500", *extra, page.as_uri())
        with Image.open(shot) as image:
            means[name] = float(np.asarray(image.convert("L")).mean())
    assert means["light"] > 200.0
    assert means["dark"] < 60.0
    pdf = tmp_path / "report.pdf"
    chromium(f"--print-to-pdf={pdf}", "--no-pdf-header-footer", page.as_uri())
    data = pdf.read_bytes()
    assert data.startswith(b"%PDF")
    # A4 in points.
    assert re.search(rb"/MediaBox \[0 0 59[45][.\d]* 84[12]", data)
