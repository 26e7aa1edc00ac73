"""The page of a run in a real browser: nothing fails, the view in three dimensions is there."""

from __future__ import annotations

import json
import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from PIL import Image

from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.run_folder import load
from airl_mav.report.run_report import build_page
from tests.support.browser import CHROMIUM, browser
from tests.support.browser import Page as Tab
from tests.support.page_alone import page_alone
from tests.support.run_demo import write_demo_run

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
window.told = [];
for (const kind of ["error", "warn"]) console[kind] = (...words) => told.push(words.join(" "));
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
addEventListener("load", async () => {
  const ready = () => document.getElementById("scene")?.dataset.shown !== undefined;
  while (!ready()) await new Promise((done) => setTimeout(done, 100));
  const report = { errors: seen, width: document.documentElement.scrollWidth, window: innerWidth };
  const box = document.getElementById("scene");
  const finish = () => {
    report.console = told;
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
  const look = () => {
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
    return { sum, colours: colours.size, shown: box.dataset.shown };
  };
  // A browser without a GPU draws when it can: what is seen has to stay the same for a while.
  let last = null;
  const frame = async (name, { changed = true, flight } = {}) => {
    let seen = null;
    for (let tries = 0, calm = 0; tries < 200 && calm < 4; tries += 1) {
      await new Promise((done) => setTimeout(done, 150));
      const now = look();
      const there = (!changed || now.sum !== last) && (!flight || now.shown === flight);
      calm = there && now.sum === seen?.sum ? calm + 1 : 0;
      seen = now;
    }
    last = seen.sum;
    report.frames[name] = seen;
  };
  const choose = (value) => { pick.value = value; pick.dispatchEvent(new Event("change")); };
  (async () => {
    report.frames = {};
    await frame("first");
    await frame("again", { changed: false });
    slider.value = slider.min; slider.dispatchEvent(new Event("input")); await frame("begin");
    report.clock = document.getElementById("scene-clock").textContent;
    choose("1"); await frame("other", { flight: "1" });
    choose("2"); await frame("last", { flight: "2" });
    await Plotly.relayout(plot, plot.layout.updatemenus[0].buttons[1].args[0]);
    await frame("above");
    report.end = true;
    finish();
  })();
});
</script>
"""


def chromium(*arguments: str) -> subprocess.CompletedProcess[str]:
    assert CHROMIUM is not None
    return subprocess.run(
        [CHROMIUM, *FLAGS, *arguments], capture_output=True, text=True, timeout=120, check=False
    )


def probe(page: Path, size: tuple[int, int], *flags: str) -> dict[str, Any]:
    """Open a page that looks at itself, in a window of a size; return what it found."""
    text = page.read_text(encoding="utf-8")
    spy = page.with_name("probe.html")
    spied = text.replace("<style>", WATCH + "<style>", 1).replace("</body>", PROBE + "</body>")
    spy.write_text(spied, encoding="utf-8")
    with (
        # Chromium's own processes may still write into its profile when it has ended.
        TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        browser(Path(folder), *flags) as tab,
    ):
        tab.resize(*size, phone=size[0] < 500)
        tab.open(spy.as_uri())
        wait_for(tab, "document.getElementById('probe')")
        return dict(json.loads(tab.evaluate("document.getElementById('probe').textContent")))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, arenas = write_demo_run(
        tmp_path_factory.mktemp("page") / "demo", episodes=3, profile="dynamic-obstacles"
    )
    with page_alone():
        return build_page(load(folder.path), arenas, vehicle=load_vehicle("quad"))


def test_nothing_fails_nothing_is_asked_for_and_the_view_moves(page: Path) -> None:
    found = probe(page, (1200, 2000))
    assert found["errors"] == found["console"] == []
    assert found["asked"] == []
    assert found["live"]
    assert found["missing"] == "none"
    assert found["flights"] == ["0", "1", "2"]
    assert found["end"]
    frames = found["frames"]
    # Floor, walls, obstacles in their shades, a path in the colours of its speed.
    assert all(frame["colours"] > 30 for frame in frames.values()), frames
    assert frames["again"]["sum"] == frames["first"]["sum"]
    assert (frames["first"]["shown"], frames["last"]["shown"]) == ("0", "2")
    sums = [frames[name]["sum"] for name in ("first", "begin", "other", "last", "above")]
    assert len(set(sums)) == len(sums)
    assert re.fullmatch(r"-?\d+\.\d s · \d+\.\d m/s", found["clock"])


@pytest.mark.nightly
def test_a_phone_scrolls_down_and_not_sideways(page: Path) -> None:
    found = probe(page, (390, 844))
    assert found["window"] <= 500
    assert found["width"] <= found["window"]


def test_without_webgl_the_page_says_so(page: Path) -> None:
    found = probe(page, (1200, 2000), "--disable-3d-apis")
    assert found["errors"] == found["console"] == []
    assert not found["live"]
    assert found["missing"] == "block"


@pytest.mark.nightly
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


SHOWN = "document.getElementById('scene')?.dataset.shown"
DRAW_S = 90.0


@pytest.fixture(scope="module")
def tab(page: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    """The page in a browser that is driven while it lives."""
    with browser(tmp_path_factory.mktemp("browser")) as tab:
        tab.resize(1200, 900)
        tab.open(page.as_uri())
        wait_for(tab, f"{SHOWN} === '0'")
        yield tab


def wait_for(tab: Tab, condition: str) -> None:
    deadline = time.monotonic() + DRAW_S
    while tab.evaluate(f"Boolean({condition})") is not True:
        assert time.monotonic() < deadline, condition
        time.sleep(0.1)


def clock_s(tab: Tab) -> float:
    return float(tab.evaluate("document.getElementById('scene-clock').textContent").split()[0])


@pytest.mark.parametrize(("width", "height"), [(1200, 900), (390, 900)])
def test_the_first_screen_has_verdict_numbers_and_picture(
    tab: Tab, width: int, height: int
) -> None:
    tab.resize(width, height, phone=width < 500)
    found = tab.evaluate(
        """(() => {
  scrollTo(0, 0);
  const first = document.querySelector(".first");
  const bottom = (each) => each.getBoundingClientRect().bottom;
  return {
    numbers: first.querySelectorAll(".headlines div").length,
    pictures: [...first.querySelectorAll("img")].map((each) => each.naturalWidth > 0),
    bottom: bottom(first),
  };
})()"""
    )
    # The views follow the width of the window.
    wait_for(tab, f"document.documentElement.scrollWidth <= {width}")
    tab.resize(1200, 900)
    assert found["numbers"] == 6
    assert found["pictures"] == [True]
    assert found["bottom"] <= height


def test_all_pictures_are_unpacked(tab: Tab) -> None:
    wait_for(tab, "[...document.images].every((each) => each.complete)")
    widths = tab.evaluate("[...document.images].map((each) => each.naturalWidth)")
    assert len(widths) > 10
    assert min(widths) > 0


def test_tracks_and_decisions_go_with_the_flight_and_the_time(tab: Tab, page: Path) -> None:
    run = load(page.parent)
    worst = tab.evaluate("document.getElementById('scene-flight').selectedOptions[0].textContent")
    record = run.episodes[int(worst.partition(":")[0])]
    assert record.navigation_us is not None
    stamps = run.latency[record.index]
    sent = (stamps["sent_us"] - record.navigation_us) / 1e6
    flown = tab.evaluate(
        """(() => {
  const { data, layout } = document.getElementById("tracks-plot");
  const of = (name, axis) => data.find((each) => each.name === name && each.yaxis === axis);
  const [commanded, moved, decisions] = [of("commanded", "y"), of("flown", "y"), of("t2", "y7")];
  return {
    rows: layout.annotations.map((each) => each.text),
    commanded: [...commanded.x, ...commanded.y],
    shape: commanded.line.shape, moved: moved.x.length, sent: decisions.x,
  };
})()"""
    )
    # No estimate is recorded here: the row of its errors is missing.
    assert [text.partition(" [")[0] for text in flown["rows"]][:4] == [
        *("velocity forward", "velocity right", "yaw rate, clockwise", "height"),
    ]
    assert flown["shape"] == "hv"
    assert flown["commanded"][: len(sent)] == pytest.approx(sent.tolist(), abs=1e-3)
    assert flown["commanded"][len(sent) + 1 : -1] == pytest.approx(
        stamps["setpoint"][:, 0].tolist(), abs=0.01
    )
    assert flown["moved"] > 100
    assert flown["sent"] == pytest.approx(sent.tolist(), abs=1e-3)
    # The depth image is drawn, and stepping through decisions moves the time.
    colours = """(() => {
  const canvas = document.getElementById("seen-depth");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return [canvas.width, canvas.height, new Set(new Uint32Array(data.buffer)).size];
})()"""
    width, height, shades = tab.evaluate(colours)
    camera = load_vehicle("quad").camera
    assert (width, height) == (camera.width_px, camera.height_px)
    assert shades > 10
    to_the_end = "const it = document.getElementById('scene-time'); it.value = it.max;"
    tab.evaluate(f"{{ {to_the_end} it.dispatchEvent(new Event('input')); }}")
    last = tab.evaluate("document.getElementById('seen-told').textContent")
    assert last.startswith(f"Decision {len(sent)} of {len(sent)}")
    assert tab.press("Before")
    wait_for(tab, f"document.getElementById('seen-told').textContent !== {json.dumps(last)}")
    assert clock_s(tab) == pytest.approx(sent[-2], abs=0.06)
    line = "document.getElementById('tracks-plot').layout.shapes.at(-1).x0"
    wait_for(tab, f"Math.abs({line} - {sent[-2]}) < 0.03")
    # A click on a decision goes to it.
    tab.evaluate(
        "document.getElementById('tracks-plot').emit('plotly_click', "
        f"{{ points: [{{ x: {sent[1]} }}] }})"
    )
    assert tab.evaluate("document.getElementById('seen-told').textContent").startswith(
        "Decision 2 "
    )


def test_a_row_of_the_worst_flights_leads_to_the_flight(tab: Tab) -> None:
    tab.evaluate("document.querySelectorAll('#worst td a')[1].click()")
    wait_for(tab, f"{SHOWN} === '1'")
    number = tab.evaluate("document.querySelectorAll('#worst td a')[1].textContent")
    told = tab.evaluate("document.getElementById('scene-flight').selectedOptions[0].textContent")
    assert told.partition(":")[0] == number


def test_a_page_of_twenty_flights_weighs_little(tmp_path: Path) -> None:
    folder, arenas = write_demo_run(tmp_path / "many", episodes=20)
    with page_alone():
        page = build_page(load(folder.path), arenas, vehicle=load_vehicle("quad"))
    assert page.stat().st_size <= 4_000_000
