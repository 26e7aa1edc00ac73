"""The view in a browser: update rates, memory and replay.

Run as `python benchmarks/bench_view.py [live memory replay]`; without arguments, all of them.
`bench_watched.py` measures the cost of a viewer for flights. Requires a Chromium,
which draws in software unless it has a GPU, and then takes processor time from everything else on
the machine. The first line shows the machine's load.

live      A flight of 31 vehicle states and 10 images a second reaches the page by the view's
          process. Counts on the page the updates of pose and image, and drawn frames; the lower
          number is visible. The same is repeated on a page of 64x64 pixels, which leaves out
          most of the cost of pixels.
memory    Half an hour of flights of a minute each, sent thirty times as fast: growth of the view's
          process and of the page's JavaScript heap, after their garbage is collected.
replay    `airl view` of a run of 100 flights: time from the command to a frame with the flight,
          and to a frame with its arena; the server's time to draw a moment; updates per second
          while the slider is dragged. If Python keeps no bytecode (PYTHONDONTWRITEBYTECODE), each
          start compiles all imports: the first line reports this.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from airl_mav.addons.view.view_messages import (  # noqa: E402
    CameraImage,
    Decided,
    Episode,
    Image,
    VehicleShape,
    VehicleState,
    ViewSettings,
)
from airl_mav.addons.view.viewer import Feed, Viewer  # noqa: E402
from airl_mav.arena.generate import generate  # noqa: E402 (from here on the checkout is found)
from airl_mav.camera.frame import depth_to_z16  # noqa: E402
from airl_mav.camera.intrinsics import Intrinsics  # noqa: E402
from airl_mav.camera.render import Mount, camera_pose, render  # noqa: E402
from airl_mav.core.frames import quat_from_euler  # noqa: E402
from airl_mav.profiles.arena import ArenaSpec  # noqa: E402
from airl_mav.profiles.loading import load_profile  # noqa: E402
from airl_mav.profiles.vehicle import load_vehicle  # noqa: E402
from airl_mav.rehearsal.live_view import ViewAddresses  # noqa: E402
from tests.support.browser import Page, browser  # noqa: E402

VEHICLE_US, PICTURE_US, DECISION_US = 32_000, 96_000, 512_000
"""Interval of states, images and decisions of the flight [simulated µs]."""

FLIGHT_US = 60_000_000
RADIUS_M, TURN_RAD_S, ALTITUDE_M = 4.0, 0.4, 2.5
"""Radius, turn rate and altitude of the circle around the start."""

COUNTING = """(() => {
  const told = {pose: 0, image: 0, walls: 0, messages: 0, frames: 0, drawn: false};
  window.told = told;
  const drawn = {flight: false, arena: false};
  // A frame puts what has arrived into the scene; the next one draws it.
  let arrived = {}, there = {};
  const Plain = window.Worker;
  window.Worker = class extends Plain {
    constructor(...words) {
      super(...words);
      this.addEventListener("message", (event) => {
        for (const message of event.data?.messages ?? event.data?.batch?.messages ?? []) {
          told.messages += 1;
          const text = message.type + " " + (message.name ?? message.uuid ?? "");
          if (/^SetPosition.* \\/flight\\/vehicle$/.test(text)) told.pose += 1;
          if (/\\/flight\\/arena\\/walls$/.test(text)) told.walls += 1;
          if (/\\/flight\\/vehicle\\/camera$/.test(text) && message.type.includes("Update"))
            told.image += 1;
        }
      });
    }
  };
  for (const name of ["drawElements", "drawArrays", "drawElementsInstanced"]) {
    const plain = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...words) {
      told.drawn = true;
      drawn.flight ||= there.flight;
      drawn.arena ||= there.arena;
      return plain.apply(this, words);
    };
  }
  const count = () => {
    if (told.drawn) told.frames += 1;
    told.drawn = false;
    if (!told.arena) {
      [told.flight, told.arena, there] = [drawn.flight, drawn.arena, arrived];
      const flight = told.pose > 0 && /seed \\d/.test(document.body?.innerText ?? "");
      arrived = {flight, arena: flight && told.walls > 0};
    }
    requestAnimationFrame(count);
  };
  requestAnimationFrame(count);
})()"""
"""Count the updates passed on by the page's worker, and the drawn frames.

`flight` and `arena` become true after a frame is drawn that contains them and the panel with the
flight's seed."""


def say(*words: object) -> None:
    print(*words, flush=True)


def load() -> str:
    one, five, _ = os.getloadavg()
    return f"load {one:.1f} (1 min), {five:.1f} (5 min) on {os.cpu_count()} cores"


@dataclass
class Counts:
    """Updates and frames of the page per second."""

    pose: float
    image: float
    frames: float


def counted(page: Page, seconds: float) -> Counts:
    """Count on the page for a while."""
    read = "[told.pose, told.image, told.frames, performance.now()]"
    before = np.array(page.evaluate(read))
    time.sleep(seconds)
    passed = np.array(page.evaluate(read)) - before
    pose, image, frames = (passed[:3] / (passed[3] / 1e3)).tolist()
    return Counts(pose, image, frames)


def open_page(page: Page, url: str) -> None:
    page.call("Page.addScriptToEvaluateOnNewDocument", source=COUNTING)
    page.resize(900, 600)
    page.open(url)


class Circle:
    """A flight in closed form, around the start of an arena with moving obstacles."""

    def __init__(self) -> None:
        spec = load_profile("arenas", "dynamic-obstacles", ArenaSpec)
        self.vehicle = load_vehicle("quad")
        self.arena = generate(spec, 3, name="dynamic-obstacles", vehicle_width_m=0.55)
        camera = self.vehicle.camera
        mount = Mount.of(camera)
        intrinsics = Intrinsics.of(camera)
        self._images: list[Image] = []
        for k in range(64):
            position, quaternion = self.pose(k * DECISION_US)[:2]
            at, attitude = camera_pose(position, quaternion, mount)
            centers = self.arena.centers_at(k * DECISION_US)
            seen = render(self.arena, centers, intrinsics, camera.range_m, at, attitude)
            self._images.append(depth_to_z16(seen))

    def pose(self, time_us: int) -> tuple[Any, Any, Any]:
        """Return position, quaternion and velocity, NED."""
        angle = TURN_RAD_S * time_us / 1e6
        north, east = RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle)
        velocity = RADIUS_M * TURN_RAD_S * np.array([-np.sin(angle), np.cos(angle), 0.0])
        attitude = quat_from_euler(-0.1, 0.0, angle + np.pi / 2)
        return np.array([north, east, -ALTITUDE_M]), attitude, velocity

    def begin(self, feed: Feed, began_us: int) -> None:
        """Report the start of a flight to a view."""
        north, east = self.arena.goal.tolist()
        feed.send(
            Episode(
                seed=3,
                started_us=began_us,
                arena=self.arena,
                vehicle=VehicleShape.of(self.vehicle),
                goal=(north, east),
                goal_radius_m=3.0,
            )
        )

    def tell(self, feed: Feed, began_us: int, time_us: int) -> None:
        """Send a view the messages due at a time since the start of the flight [µs]."""
        position, quaternion, velocity = self.pose(time_us)
        image = self._images[time_us // PICTURE_US % len(self._images)]
        height, width = image.shape
        now_us = began_us + time_us
        feed.send(
            VehicleState(
                time_us=now_us,
                position=tuple(position.tolist()),
                velocity=tuple(velocity.tolist()),
                quaternion=tuple(quaternion.tolist()),
                rotors=(0.5, 0.5, 0.5, 0.5),
                battery=0.9,
                mode="offboard",
                armed=True,
                collision=None,
            )
        )
        if time_us % PICTURE_US == 0:
            feed.send(CameraImage(captured_us=now_us, shape=(height, width)), image)
        if time_us % DECISION_US == 0:
            setpoint = (RADIUS_M * TURN_RAD_S, 0.0, 0.0, TURN_RAD_S)
            stamps = (now_us - 60_000, now_us - 50_000, now_us - 1_000, now_us)
            names = ("captured_us", "began_us", "ready_us", "sent_us")
            decided = Decided(
                **dict(zip(names, stamps, strict=True)),
                expires_us=None,
                setpoint=setpoint,
                compensated=False,
                shape=(height, width),
            )
            feed.send(decided, image)

    def fly(self, feed: Feed, seconds: float, speed: float, began_us: int = 0) -> None:
        """Fly a number of simulated seconds at a pace, in flights of a minute."""
        started, end_us = time.monotonic(), round(1e6 * seconds)
        for now_us in range(0, end_us, VEHICLE_US):
            flight = now_us // FLIGHT_US * FLIGHT_US
            if now_us - flight < VEHICLE_US:
                self.begin(feed, began_us + flight)
            self.tell(feed, began_us + flight, (now_us - flight) // VEHICLE_US * VEHICLE_US)
            ahead = now_us / 1e6 / speed - (time.monotonic() - started)
            if ahead > 0.0:
                time.sleep(ahead)


@contextmanager
def viewed(*, paced: bool = False) -> Iterator[Viewer]:
    """Open a view; `paced`: of a flight whose pace and latency its watchers set."""
    request = ViewSettings(
        run="bench",
        port=None,
        paced=paced,
        speed=None,
        compensable=False,
        compensated=False,
    )
    with closing(Viewer(request)) as viewer:
        yield viewer


def drawing_process() -> psutil.Process:
    """Return the view's own process."""
    children = psutil.Process().children()
    return next(each for each in children if "airl_mav.addons.view.view_server" in each.cmdline())


@contextmanager
def flying(ends: ViewAddresses, seconds: float, speed: float) -> Iterator[subprocess.Popen[bytes]]:
    """Fly the circle in a separate process, so that counting does not slow it down."""
    words = [sys.executable, __file__, "--fly", ends.model_dump_json(), str(seconds), str(speed)]
    process = subprocess.Popen(words)  # noqa: S603 (this file)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def wait_for(condition: Callable[[], Any], seconds: float = 60.0) -> None:
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it does not come true"
        time.sleep(0.02)


# --- what is measured


def measure_live(folder: Path) -> None:
    with viewed() as viewer, browser(folder) as page, flying(viewer.ends, 300.0, 1.0):
        open_page(page, viewer.url)
        wait_for(lambda: page.evaluate("window.told?.pose > 20"))
        server = next(
            p
            for p in psutil.Process().children()
            if "airl_mav.addons.view.view_server" in p.cmdline()
        )
        for size, name in (((900, 600), "page 900x600"),):
            page.resize(*size)
            before, began = server.cpu_times(), time.monotonic()
            found = counted(page, 10.0)
            after, passed = server.cpu_times(), time.monotonic() - began
            cpu = (after.user + after.system - before.user - before.system) / passed
            say(
                f"{name}: pose {found.pose:.1f}/s, image {found.image:.1f}/s arrive,"
                f" {found.frames:.1f} frames/s drawn; the view's process takes {cpu:.0%} of a core;"
                f" {load()}"
            )
        # With few pixels, the remaining cost is the server, the socket and JavaScript.
        page.resize(64, 64)
        found = counted(page, 10.0)
        say(
            f"server, page 64x64: pose {found.pose:.1f}/s, image {found.image:.1f}/s arrive,"
            f" {found.frames:.1f} frames/s drawn"
        )


def heap_mb(page: Page) -> float:
    """Return the page's JavaScript heap after a collection [MB]."""
    page.call("HeapProfiler.collectGarbage")
    return float(page.call("Runtime.getHeapUsage")["usedSize"]) / 1e6


def measure_memory(folder: Path, minutes: float = 30.0, speed: float = 30.0) -> None:
    with viewed() as viewer, browser(folder) as page:
        open_page(page, viewer.url)
        server = next(
            p
            for p in psutil.Process().children()
            if "airl_mav.addons.view.view_server" in p.cmdline()
        )
        with flying(viewer.ends, 60.0 * minutes, speed) as flight:
            wait_for(lambda: page.evaluate("window.told?.pose > 20"))
            rows = []
            while flight.poll() is None:
                rows.append(
                    (
                        page.evaluate("told.pose"),
                        page.evaluate("told.messages"),
                        server.memory_info().rss / 1e6,
                        heap_mb(page),
                    )
                )
                time.sleep(60.0 * minutes / speed / 8.0)
        for pose, messages, rss, heap in rows:
            say(
                f"  {pose:6d} poses, {messages:7d} messages: server {rss:6.1f} MB,"
                f" page {heap:5.1f} MB"
            )
        half = rows[len(rows) // 2 :]
        poses = half[-1][0] - half[0][0]
        say(
            f"{minutes:g} min of flights at {speed:g} x; over the second half, {poses} poses drawn:"
            f" server {half[-1][2] - half[0][2]:+.1f} MB, page {half[-1][3] - half[0][3]:+.1f} MB;"
            f" {load()}"
        )


def measure_replay(folder: Path, flights: int = 100) -> None:
    run = folder / "run"
    airl = [sys.executable, "-m", "airl_mav.cli.main"]
    words = [*airl, "evaluate", "static-obstacles", "--episodes", str(flights), "--out", str(run)]
    subprocess.run([*words, "--quiet"], check=True, cwd=ROOT, stdout=subprocess.DEVNULL)  # noqa: S603
    with browser(folder) as page:
        page.call("Page.addScriptToEvaluateOnNewDocument", source=COUNTING)
        page.resize(900, 600)
        for attempt in ("first", "again"):
            began = time.monotonic()
            process = subprocess.Popen(  # noqa: S603
                [*airl, "view", str(run)], cwd=ROOT, stdout=subprocess.PIPE, text=True
            )
            try:
                assert process.stdout is not None
                url = process.stdout.readline().split()[-1]
                served = time.monotonic() - began
                page.open(url)
                wait_for(lambda: page.evaluate("window.told?.flight"))
                shown = time.monotonic() - began
                wait_for(lambda: page.evaluate("told.arena"))
                whole = time.monotonic() - began
                say(f"replay of {flights} flights, {attempt}: served after {served:.2f} s, shown"
                    f" after {shown:.2f} s, with arena after {whole:.2f} s; {load()}")  # fmt: skip
                moves, found = scrub(page)
                say(
                    f"scrubbing: the page takes {moves:.1f} moves/s; pose {found.pose:.1f}/s"
                    f" arrives, {found.frames:.1f} frames/s drawn"
                )
            finally:
                process.terminate()
                process.wait()
                page.open("about:blank")
    measure_drawing(run)


def scrub(page: Page) -> tuple[float, Counts]:
    """Drag the time slider back and forth for 5 s, as often as the page accepts it, and count.

    Returns:
        Moves per second, and the resulting updates.
    """
    assert page.press("Pause")
    find = """(() => {
  const slider = document.querySelector("[role=slider]").closest("[class*=Slider-root]");
  const box = slider.getBoundingClientRect();
  return [box.x, box.y + box.height / 2, box.width];
})()"""
    left, y, width = page.evaluate(find)

    def mouse(kind: str, share: float, **more: Any) -> None:
        at = {"x": left + share * width, "y": y}
        page.call("Input.dispatchMouseEvent", type=kind, button="left", **at, **more)

    mouse("mousePressed", 0.2, buttons=1, clickCount=1)
    read = "[told.pose, told.image, told.frames, performance.now()]"
    before = np.array(page.evaluate(read))
    end, moves = time.monotonic() + 5.0, 0
    while time.monotonic() < end:
        moves += 1
        mouse("mouseMoved", 0.5 + 0.3 * np.sin(0.1 * moves), buttons=1)
    passed = np.array(page.evaluate(read)) - before
    mouse("mouseReleased", 0.5, clickCount=1)
    pose, image, frames, many = (np.append(passed[:3], moves) / (passed[3] / 1e3)).tolist()
    return many, Counts(pose, image, frames)


def measure_drawing(run: Path) -> None:
    """Measure the server's time to draw a moment of a replayed flight in the scene."""
    import viser

    from airl_mav.addons.view.replay_page import ReplayPage
    from airl_mav.addons.view.replayed_flight import ReplayedRun

    began = time.process_time()
    replayed = ReplayedRun(run)
    read = time.process_time() - began
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        page = ReplayPage(server, replayed)
        took = []
        for k in range(200):
            page._go_to(0.02 * k)
            start = time.process_time()
            page.draw()
            took.append(time.process_time() - start)
    finally:
        server.stop()
    say(
        f"server: the run is read in {read:.2f} s; a moment of a flight takes"
        f" {1e3 * statistics.median(took):.1f} ms of processor time to draw, panel included"
    )


MEASURES = {
    "live": measure_live,
    "memory": measure_memory,
    "replay": measure_replay,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="*", choices=[*MEASURES, []], help="by default all")
    parser.add_argument("--fly", nargs=3, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.fly:
        ends, seconds, speed = asked.fly
        with closing(Feed(ViewAddresses.model_validate_json(ends))) as feed:
            Circle().fly(feed, float(seconds), float(speed))
        return
    say(load() + ("; Python keeps no bytecode" if sys.dont_write_bytecode else ""))
    for name in asked.what or MEASURES:
        say(f"--- {name}")
        with tempfile.TemporaryDirectory() as folder:
            MEASURES[name](Path(folder))


if __name__ == "__main__":
    main()
