"""Images that take longer than a tick: drawn in another process, late, and the same."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
import psutil
import pytest

from airl_mav.arena.generate import generate
from airl_mav.arena.geometry import Arena
from airl_mav.camera.frame import Frame
from airl_mav.camera.render import Motion
from airl_mav.core.constants import TICK_US
from airl_mav.core.frames import quat_from_euler
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.projections import Renderer
from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.interfaces import FirmwareLostError
from firmware_sim.plant.camera import CameraProcess, SimulatedCamera, SlowCamera

RATE_HZ = 20.0
SLOT_US = 50_000
WAIT_S = 120.0


def arena(name: str = "dynamic-obstacles") -> Arena:
    return generate(load_profile("arenas", name, ArenaSpec), 5, name=name, vehicle_width_m=0.5)


CAMERA = load_vehicle("quad").camera.model_copy(
    update={"rate_hz": RATE_HZ, "width_px": 32, "height_px": 24}
)
COLOUR = CAMERA.model_copy(update={"kind": "rgb"})


@pytest.fixture(scope="module")
def process() -> Iterator[CameraProcess]:
    made = CameraProcess()
    yield made
    made.close()


def moving(time_us: int) -> Motion:
    """Fly a circle, turning."""
    angle = time_us * 1e-6
    at = np.array([10.0 + 3.0 * np.cos(angle), 10.0 + 3.0 * np.sin(angle), -2.0])
    return Motion.at_rest(at, quat_from_euler(0.0, 0.0, angle))


def child() -> psutil.Process:
    """Return the newest process that takes images."""
    found = [
        each for each in psutil.Process().children() if "plant.camera" in " ".join(each.cmdline())
    ]
    return max(found, key=psutil.Process.create_time)


def fly(camera: SlowCamera, from_us: int, until: Callable[[list[Frame]], bool]) -> list[Frame]:
    """Offer every tick, a few times as fast as in flight; return what is published."""
    seen: list[Frame] = []
    end, now_us = time.monotonic() + WAIT_S, from_us
    while not until(seen):
        assert time.monotonic() < end, f"{len(seen)} frames"
        if now_us >= camera.next_us:
            camera.offer(now_us, moving(now_us), seen.append)
        now_us += TICK_US
        time.sleep(1e-3)
    return seen


def the_same_in_place(
    frames: list[Frame], start_us: int, renderer: Renderer = "raycast", camera: Camera = CAMERA
) -> None:
    """Hold frames against a camera that takes its time in the place of ticks."""
    drawn = SimulatedCamera(camera, arena(), start_us, None, 3, renderer)
    for frame in frames:
        expected = drawn.take(frame.capture_time_us, moving(frame.capture_time_us))
        np.testing.assert_array_equal(frame.image, expected.image)
        assert frame.sequence == expected.sequence


def test_frames_are_those_of_a_camera_for_which_time_waits(process: CameraProcess) -> None:
    camera = process.camera(CAMERA, arena(), 8_000, None, 3, "raycast")
    frames = fly(camera, 8_000, lambda seen: len(seen) == 5)
    the_same_in_place(frames, 8_000)
    times = [frame.capture_time_us for frame in frames]
    assert times[0] == 8_000
    # One a slot, wherever in it the camera was free: on a busy machine it may be late in one.
    slots = [(time_us - 8_000) // SLOT_US for time_us in times]
    assert all(later > earlier for earlier, later in pairwise(slots))


def test_one_at_a_time_and_slots_that_pass_meanwhile_are_left_out(process: CameraProcess) -> None:
    camera = process.camera(CAMERA, arena(), 0, None, 3, "raycast")
    seen: list[Frame] = []
    camera.offer(0, moving(0), seen.append)
    at_work = child()
    at_work.suspend()
    try:
        for k in range(1, 60):  # 240 ms: four slots
            camera.offer(k * TICK_US, moving(k * TICK_US), seen.append)
    finally:
        at_work.resume()
    frames = seen + fly(camera, 60 * TICK_US, lambda more: len(seen) + len(more) >= 2)
    assert [each.sequence for each in frames] == [0, 1]
    if not seen:  # It was stopped before it had answered.
        assert frames[1].capture_time_us >= 240_000
    the_same_in_place(frames, 0)


def test_an_episode_drops_what_was_taken_for_the_one_before(process: CameraProcess) -> None:
    camera = process.camera(CAMERA, arena(), 0, None, 3, "raycast")
    seen: list[Frame] = []
    camera.offer(0, moving(0), seen.append)
    camera.restart(1_000_000)
    frames = fly(camera, 1_000_000, lambda more: len(more) == 3)
    assert not seen
    assert frames[0].capture_time_us >= 1_000_000
    # Obstacle tours restart at 1 s, and the images show it.
    drawn = SimulatedCamera(CAMERA, arena(), 1_000_000, None, 3)
    for frame in frames:
        at = frame.capture_time_us
        np.testing.assert_array_equal(frame.image, drawn.take(at, moving(at)).image)


def test_one_process_serves_one_episode_after_the_other(process: CameraProcess) -> None:
    first = process.camera(CAMERA, arena(), 0, None, 3, "raycast")
    at_work = child().pid
    first.offer(0, moving(0), lambda frame: None)  # It is still being taken.
    camera = process.camera(CAMERA, arena(), 40_000, None, 3, "raycast")
    assert child().pid == at_work
    the_same_in_place(fly(camera, 40_000, lambda seen: len(seen) == 2), 40_000)


@pytest.mark.nightly
def test_path_traced_images_are_those_of_lockstep(process: CameraProcess) -> None:
    pytest.importorskip("mitsuba")
    camera = process.camera(COLOUR, arena(), 0, None, 3, "mitsuba")
    the_same_in_place(fly(camera, 0, lambda seen: len(seen) == 2), 0, "mitsuba", COLOUR)


def test_a_process_that_dies_ends_the_flight_in_one_line() -> None:
    process = CameraProcess()
    try:
        camera = process.camera(CAMERA, arena(), 0, None, 3, "raycast")
        child().kill()
        died = r"draws the camera's images has ended by signal 9$"
        with pytest.raises(FirmwareLostError, match=died):
            fly(camera, 0, lambda _: False)
    finally:
        process.close()


ORPHANED = """
import os, sys
from tests.firmware.test_camera_process import CAMERA, CameraProcess, arena, child
process = CameraProcess()
process.camera(CAMERA, arena(), 0, None, 3, "raycast")
print(child().pid, flush=True)
sys.stdin.read()
"""


def test_it_ends_with_the_one_that_has_started_it() -> None:
    starter = subprocess.Popen(
        [sys.executable, "-c", ORPHANED], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert starter.stdout is not None
    orphan = psutil.Process(int(starter.stdout.readline()))
    os.kill(starter.pid, signal.SIGKILL)
    starter.communicate()
    gone, _ = psutil.wait_procs([orphan], WAIT_S)
    assert gone


def test_it_gives_way_to_those_that_keep_time(process: CameraProcess) -> None:
    process.camera(CAMERA, arena(), 0, None, 3, "raycast")
    assert child().nice() > psutil.Process().nice()
    assert os.getsid(child().pid) == child().pid


@pytest.mark.nightly
def test_a_frame_has_the_images_of_all_cameras(process: CameraProcess) -> None:
    further = load_vehicle("quad-rig").cameras
    camera = process.camera(CAMERA, arena(), 0, None, 3, "raycast", further)
    frames = fly(camera, 0, lambda seen: len(seen) == 2)
    drawn = SimulatedCamera(CAMERA, arena(), 0, None, 3, further=further)
    for frame in frames:
        at = frame.capture_time_us
        expected = drawn.take(at, moving(at))
        assert frame.further.keys() == {"down", "left", "right"}
        for name, each in expected.further.items():
            np.testing.assert_array_equal(frame.further[name].image, each.image)
