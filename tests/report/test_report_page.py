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
    "--virtual-time-budget=4000",
    "--enable-logging=stderr",
)

WATCH = """<script>
window.seen = [];
// Frames by the clock that the test moves, not by the screen's.
window.requestAnimationFrame = (act) => setTimeout(() => act(performance.now()), 1);
addEventListener("error", (event) => seen.push(`${event.message}`));
addEventListener("unhandledrejection", (event) => seen.push(`${event.reason}`));
</script>
"""

PROBE = """<script>
addEventListener("load", () => setTimeout(() => {
  const report = { errors: seen, width: document.documentElement.scrollWidth, window: innerWidth };
  const box = document.getElementById("scene");
  if (box) {
    const canvas = box.querySelector("canvas");
    const gl = canvas.getContext("webgl");
    report.gl = Boolean(gl);
    report.live = box.classList.contains("live");
    report.still = getComputedStyle(box.querySelector("img")).display;
    report.flights = [...document.getElementById("scene-flight").options].map((o) => o.value);
    const frame = () => new Promise((done) => setTimeout(() => {
      const [w, h] = [canvas.width, canvas.height];
      const pixels = new Uint8Array(4 * w * h);
      gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
      let sum = 0;
      const colours = new Set();
      for (let i = 0; i < pixels.length; i += 4) {
        sum = (sum * 31 + pixels[i] + 7 * pixels[i + 1] + 13 * pixels[i + 2]) % 1000003;
        colours.add((pixels[i] << 16) | (pixels[i + 1] << 8) | pixels[i + 2]);
      }
      done({ sum, colours: colours.size });
    }, 20));
    const press = (key) => canvas.dispatchEvent(new KeyboardEvent("keydown", { key }));
    const slider = document.getElementById("scene-time");
    const pick = document.getElementById("scene-flight");
    const choose = (value) => { pick.value = value; pick.dispatchEvent(new Event("change")); };
    if (!gl) { finish(); return; }
    (async () => {
      report.frames = {};
      const note = async (name) => { report.frames[name] = await frame(); };
      press("0"); await note("first");
      press("ArrowLeft"); await note("turned");
      press("0"); await note("back");
      slider.value = slider.min; slider.dispatchEvent(new Event("input")); await note("begin");
      report.clock = document.getElementById("scene-clock").textContent;
      choose("1"); await note("other");
      choose("all"); await note("all");
      box.querySelector("[data-stand=above]").click(); await note("above");
      report.end = true;
      finish();
    })();
  } else finish();
  function finish() {
    const out = document.createElement("pre");
    out.id = "probe";
    out.textContent = JSON.stringify(report);
    document.body.append(out);
  }
}, 200));
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
    # What is drawn would be gone before it could be looked at.
    spied = spied.replace("antialias: true,", "antialias: true, preserveDrawingBuffer: true,")
    spy.write_text(spied, encoding="utf-8")
    found = chromium("--dump-dom", *arguments, spy.as_uri())
    told = re.search(r'<pre id="probe">(.*?)</pre>', found.stdout, re.DOTALL)
    assert told, found.stderr[-2000:]
    console = [
        line
        for line in found.stderr.splitlines()
        if ":CONSOLE:" in line and "GL Driver Message" not in line
    ]
    return json.loads(html.unescape(told[1])), console


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, arenas = write_demo_run(
        tmp_path_factory.mktemp("page") / "demo", episodes=3, profile="dynamic-obstacles"
    )
    return build_page(load(folder.path), arenas, vehicle=load_vehicle("quad"))


def test_nothing_fails_and_the_view_turns(page: Path) -> None:
    found, console = probe(page, "--window-size=1200,2000")
    assert found["errors"] == []
    assert console == []
    assert found["end"]
    assert found["live"]
    assert found["still"] == "none"
    assert found["flights"] == ["0", "1", "2", "all"]
    frames = found["frames"]
    # Floor, walls, obstacles in their shades, a path in the colours of its speed.
    assert all(frame["colours"] > 30 for frame in frames.values()), frames
    assert frames["turned"]["sum"] != frames["first"]["sum"]
    assert frames["back"]["sum"] == frames["first"]["sum"]
    sums = [frames[name]["sum"] for name in ("first", "begin", "other", "all", "above")]
    assert len(set(sums)) == len(sums)
    assert re.fullmatch(r"-?\d+\.\d s · \d+\.\d m/s", found["clock"])


def test_a_phone_scrolls_down_and_not_sideways(page: Path) -> None:
    found, _ = probe(page, "--window-size=390,844")
    assert found["window"] <= 500
    assert found["width"] <= found["window"]


def test_without_webgl_the_picture_stays(page: Path) -> None:
    found, console = probe(page, "--disable-3d-apis", "--window-size=1200,2000")
    assert found["errors"] == []
    assert console == []
    assert not found["gl"]
    assert not found["live"]
    assert found["still"] == "block"


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
