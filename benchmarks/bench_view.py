"""The view in a browser: update rates, memory, replay, and what a watcher costs.

Run as `python benchmarks/bench_view.py [live memory replay flights training]`; without words, all
of them. It needs a Chromium, which draws in software unless it has a GPU: what it takes is then
taken from everything else on the machine, whose load stands in the first line.

live      A flight of 31 vehicle states and 10 images a second reaches the page by the view's
          own process. Counted on the page: updates of the vehicle's pose and of the camera's image
          that arrive, and frames that are drawn; the lower of the two is what is seen. The same
          again on a page of 64x64 pixels, which leaves out most of what pixels take.
memory    Half an hour of flights of a minute each, sent thirty times as fast: growth of the view's
          process and of the page's JavaScript heap, after their garbage is collected.
replay    `airl view` of a run of 100 flights: from the command to the flight on the page, how long
          a moment takes to be drawn by the server, and updates a second while the slider is
          dragged.
flights   Pairs of the same lockstep flight, alone and with a page that watches: fingerprints, and
          wall time at full speed. Pairs at level sitl: t2 and how late the vehicle's ticks were.
training  Pairs of the same short training, alone and watched: weights, and wall time.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from airl_mav.arena.generate import generate  # noqa: E402 (from here on the checkout is found)
from airl_mav.camera.frame import depth_to_z16  # noqa: E402
from airl_mav.camera.intrinsics import Intrinsics  # noqa: E402
from airl_mav.camera.render import Mount, camera_pose, render  # noqa: E402
from airl_mav.core.frames import quat_from_euler  # noqa: E402
from airl_mav.profiles.arena import ArenaSpec  # noqa: E402
from airl_mav.profiles.loading import load_profile  # noqa: E402
from airl_mav.profiles.vehicle import load_vehicle  # noqa: E402
from airl_mav.scenario.model import Scenario  # noqa: E402
from airl_mav.scenario.resolve import resolve  # noqa: E402
from airl_mav.view.ends import ViewEnds  # noqa: E402
from airl_mav.view.feed import Feed  # noqa: E402
from airl_mav.view.handshake import Request  # noqa: E402
from airl_mav.view.messages import (  # noqa: E402
    ArenaShown,
    Decided,
    Episode,
    Image,
    Picture,
    Vehicle,
    VehicleShape,
)
from airl_mav.view.viewer import Viewer  # noqa: E402
from tests.support.browser import Page, browser  # noqa: E402
from tests.support.processes import SITL_WITHOUT_REPORT  # noqa: E402

VEHICLE_US, PICTURE_US, DECISION_US = 32_000, 96_000, 512_000
"""Between two states, images and decisions of the flight [simulated µs]."""

FLIGHT_US = 60_000_000
RADIUS_M, TURN_RAD_S, ALTITUDE_M = 4.0, 0.4, 2.5
"""Of the circle that is flown around the start."""

COUNTING = """(() => {
  const told = {pose: 0, image: 0, messages: 0, frames: 0, drawn: false};
  window.told = told;
  const Plain = window.Worker;
  window.Worker = class extends Plain {
    constructor(...words) {
      super(...words);
      this.addEventListener("message", (event) => {
        for (const message of event.data?.messages ?? event.data?.batch?.messages ?? []) {
          told.messages += 1;
          const text = message.type + " " + (message.name ?? message.uuid ?? "");
          if (/^SetPosition.* \\/flight\\/vehicle$/.test(text)) told.pose += 1;
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
      return plain.apply(this, words);
    };
  }
  const count = () => {
    if (told.drawn) told.frames += 1;
    told.drawn = false;
    requestAnimationFrame(count);
  };
  requestAnimationFrame(count);
})()"""
"""Counts what the page's worker hands over, and the frames in which anything was drawn."""


def say(*words: object) -> None:
    print(*words, flush=True)


def load() -> str:
    one, five, _ = os.getloadavg()
    return f"load {one:.1f} (1 min), {five:.1f} (5 min) on {os.cpu_count()} cores"


@dataclass
class Counts:
    """Of the page, a second."""

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
        mount = Mount((camera.forward_m, 0.0, -camera.up_m), np.deg2rad(camera.pitch_up_deg))
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
        """Tell a view that the flight begins."""
        north, east = self.arena.goal.tolist()
        feed.send(
            Episode(
                seed=3,
                started_us=began_us,
                arena=ArenaShown.of(self.arena),
                vehicle=VehicleShape.of(self.vehicle),
                goal=(north, east),
                goal_radius_m=3.0,
            )
        )

    def tell(self, feed: Feed, began_us: int, time_us: int) -> None:
        """Tell a view what is due at a time since the flight's beginning [µs]."""
        position, quaternion, velocity = self.pose(time_us)
        image = self._images[time_us // PICTURE_US % len(self._images)]
        height, width = image.shape
        now_us = began_us + time_us
        feed.send(
            Vehicle(
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
            feed.send(Picture(captured_us=now_us, shape=(height, width)), image)
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
        """Fly so many simulated seconds at a pace, in flights of a minute."""
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
def viewed() -> Iterator[Viewer]:
    request = Request(
        run="bench",
        port=None,
        paced=False,
        speed=None,
        steerable=False,
        compensable=False,
        compensated=False,
    )
    with closing(Viewer(request)) as viewer:
        yield viewer


def drawing_process() -> psutil.Process:
    """Return the view's own process."""
    children = psutil.Process().children()
    return next(each for each in children if "airl_mav.view.server" in each.cmdline())


@contextmanager
def flying(ends: ViewEnds, seconds: float, speed: float) -> Iterator[subprocess.Popen[bytes]]:
    """Fly the circle in a process of its own, so that counting does not hold it back."""
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
            p for p in psutil.Process().children() if "airl_mav.view.server" in p.cmdline()
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
        # Nothing is drawn at a pixel: what is left is the server, the socket and JavaScript.
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
            p for p in psutil.Process().children() if "airl_mav.view.server" in p.cmdline()
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
                wait_for(lambda: "seed" in page.text() and page.evaluate("window.told?.pose > 0"))
                shown = time.monotonic() - began
                say(f"replay of {flights} flights, {attempt}: served after {served:.2f} s, shown"
                    f" after {shown:.2f} s; {load()}")  # fmt: skip
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
    """Drag the slider of time to and fro for 5 s, as often as the page takes it, and count.

    Returns:
        Moves a second, and what came of them.
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
    """What the server takes to put a moment of a replayed flight into the scene."""
    import viser

    from airl_mav.report.replay.page import ReplayPage
    from airl_mav.report.replay.runs import ReplayedRun

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


def measure_flights(folder: Path, pairs: int = 4) -> None:
    from airl_mav.lockstep.flight import fly

    resolved = resolve(
        Scenario(policy="static-obstacles", level="lockstep", time_limit_s=60.0, speed=None)
    )

    def lockstep(ends: ViewEnds | None) -> tuple[float, str]:
        gc.collect()
        began = time.monotonic()
        record = fly(resolved, resolved.fresh_policy(11), 0, 11, view=ends).record
        return time.monotonic() - began, str(record.sha256)

    lockstep(None)
    request = Request(run="bench", port=None, paced=True, speed=None, steerable=True,
                      compensable=False, compensated=False)  # fmt: skip
    with closing(Viewer(request)) as viewer, ExitStack() as held:
        unseen = [(lockstep(None), lockstep(viewer.ends)) for _ in range(pairs)]
        page = held.enter_context(browser(folder))
        page.resize(900, 600)
        page.open(viewer.url)
        wait_for(lambda: "phase" in page.text())
        seen = [(lockstep(None), lockstep(viewer.ends)) for _ in range(pairs)]
    digests = {sha for pair in (*unseen, *seen) for _, sha in pair}
    for name, rows in (("with --view, nobody there", unseen), ("with a page", seen)):
        ratio = statistics.median(watched[0] / alone[0] for alone, watched in rows)
        say(f"lockstep at full speed, {name}: {ratio:.2f} times the wall time of alone"
            f" ({rows[0][0][0]:.2f} s); {load()}")  # fmt: skip
    say(f"fingerprints of all {4 * pairs} flights: {'the same' if len(digests) == 1 else digests}")
    measure_sitl(folder)


def measure_sitl(folder: Path, pairs: int = 2) -> None:
    """Two flights at level sitl alone, two watched, in turn."""
    rows: dict[str, list[tuple[float, float, float]]] = {"alone": [], "watched": []}
    for k in range(pairs):
        for name in rows:
            out = folder / f"sitl-{name}-{k}"
            words = [sys.executable, *SITL_WITHOUT_REPORT, "--episodes", "1", "--seed", "11"]
            words += ["--out", str(out), "--policy", "static-obstacles"]
            with ExitStack() as held:
                process = subprocess.Popen(  # noqa: S603
                    words + (["--view"] if name == "watched" else []),
                    cwd=ROOT,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
                assert process.stdout is not None
                if name == "watched":
                    line = next(each for each in process.stdout if "view" in each)
                    profile = folder / f"browser-{k}"
                    profile.mkdir()
                    page = held.enter_context(browser(profile))
                    page.resize(900, 600)
                    page.open(line.split()[-1])
                process.stdout.read()
                process.wait()
            rows[name].append(of_sitl(out))
    for name, found in rows.items():
        median, worst, slip = np.array(found).mean(axis=0)
        say(
            f"sitl, {name}: t2 median {median:.2f} ms, greatest {worst:.1f} ms; simulated time"
            f" given up {slip:.1f} ms a flight; {load()}"
        )


def of_sitl(out: Path) -> tuple[float, float, float]:
    """Return median and greatest t2 of a run's flight, and the time that its host gave up [ms]."""
    from airl_mav.rehearsal.run_folder import load as load_run

    run = load_run(out)
    (record,) = run.episodes
    stamps = run.latency[record.index]
    t2_us = stamps["action_ready_us"] - stamps["infer_start_us"]
    return float(np.median(t2_us)) / 1e3, float(t2_us.max()) / 1e3, record.slipped_us / 1e3


TRAINING = """
description = "a short one"
steps = 6_000
vehicles = 32
[environment]
arena = "dynamic-obstacles"
[algorithm]
learning_starts = 500
[selection]
every = 100_000
episodes = 1
"""


def measure_training(folder: Path, pairs: int = 3) -> None:
    (folder / "bench.toml").write_text(TRAINING, encoding="utf-8")
    ratios, weights = [], set()
    with viewed() as viewer:
        for k in range(pairs + 1):
            took = {}
            for ends in (None, viewer.ends):
                out = folder / f"train-{k}-{ends is not None}"
                # A process each: what one has compiled, allocated and cached is not the other's.
                words = [sys.executable, __file__, "--train", str(folder / "bench.toml"), str(out)]
                words += [] if ends is None else [ends.model_dump_json()]
                done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True)  # noqa: S603
                wall, cpu = map(float, done.stdout.split()[-2:])
                took[ends is not None] = wall, cpu
                with zipfile.ZipFile(out / "best" / "model.zip") as saved:
                    weights.add(hashlib.sha256(saved.read("policy.pth")).hexdigest())
            if k:  # the first pair compiles
                ratios.append((took[True][0] / took[False][0], took[True][1] / took[False][1]))
    wall, cpu = np.median(np.array(ratios), axis=0)
    say(
        f"training, watched: {wall:.3f} times the wall time, {cpu:.3f} times the processor time;"
        f" weights {'the same' if len(weights) == 1 else 'DIFFER'}; {load()}"
    )


def train(config: str, out: str, ends: str | None) -> None:
    """Train once, and print wall and processor time."""
    from airl_mav.training.config import TrainingConfig
    from airl_mav.training.run import train as learn

    view = None if ends is None else ViewEnds.model_validate_json(ends)
    wall, cpu = time.monotonic(), time.process_time()
    learn(load_profile("training", config, TrainingConfig), Path(out), name="bench", view=view)
    print(time.monotonic() - wall, time.process_time() - cpu)


MEASURES = {
    "live": measure_live,
    "memory": measure_memory,
    "replay": measure_replay,
    "flights": measure_flights,
    "training": measure_training,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="*", choices=[*MEASURES, []], help="by default all")
    parser.add_argument("--fly", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--train", nargs="+", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.fly:
        ends, seconds, speed = asked.fly
        with closing(Feed(ViewEnds.model_validate_json(ends))) as feed:
            Circle().fly(feed, float(seconds), float(speed))
        return
    if asked.train:
        train(*asked.train, *[None] * (3 - len(asked.train)))
        return
    say(load())
    for name in asked.what or MEASURES:
        say(f"--- {name}")
        with tempfile.TemporaryDirectory() as folder:
            MEASURES[name](Path(folder))


if __name__ == "__main__":
    main()
