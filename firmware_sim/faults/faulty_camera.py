"""Camera faults: no frames, a frozen image, depth noise, delayed frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from numpy.typing import NDArray

from airl_mav.camera.frame import Frame
from airl_mav.camera.noise import DepthNoise, noisy_frame
from airl_mav.camera.render import Motion
from airl_mav.core.constants import US_PER_S
from airl_mav.faults.kinds import NOISE_SEED
from airl_mav.profiles.conditions import SensorNoise
from firmware_sim.faults.fault_timeline import Acting, FaultTimeline
from firmware_sim.plant.camera import OnboardCamera


class FailingCamera:
    """Camera with faults, inserted only in episodes with faults."""

    def __init__(self, camera: OnboardCamera, timeline: FaultTimeline, seed: int) -> None:
        """Wrap a healthy camera, with the faults and the seed of the episode."""
        self._camera = camera
        self._timeline = timeline
        self._seed = seed
        self._acting: list[Acting] = []
        self._frozen: Frame | None = None
        self._late: deque[tuple[int, Frame]] = deque()
        timeline.on_change(self._rearrange)

    @property
    def next_us(self) -> int:
        """Simulated time of the next exposure or delayed frame [µs]."""
        next_us = self._camera.next_us
        return min(next_us, self._late[0][0]) if self._late else next_us

    def restart(self, time_us: int) -> None:
        """Begin an episode at `time_us` [µs]."""
        self._late.clear()
        self._camera.restart(time_us)

    def offer(self, time_us: int, motion: Motion, publish: Callable[[Frame], None]) -> None:
        """Pass due frames to `publish`; see `OnboardCamera.offer`."""
        if time_us >= self._camera.next_us:
            self._camera.offer(time_us, motion, lambda frame: self._take(frame, publish))
        while self._late and self._late[0][0] <= time_us:
            publish(self._late.popleft()[1])

    def skip_unread(self, read_us: int) -> None:
        """Skip nothing: a delayed or frozen frame may be read later."""

    def _take(self, frame: Frame, publish: Callable[[Frame], None]) -> None:
        delay_us = 0
        for each in self._acting:
            kind = each.fault.kind
            if kind == "off":
                return
            if kind == "delay":
                delay_us += round(each.fault.amount * US_PER_S)
            elif kind == "noise":
                noise = DepthNoise(None, SensorNoise(depth_noise=each.fault.amount))
                seed = NOISE_SEED * (each.number + 1) + self._seed
                depth = noisy_frame(frame.depth_mm, noise, seed, frame.sequence)
                frame = _showing(frame, depth, frame.jpeg)
            else:  # stuck
                if self._frozen is None:
                    self._frozen = frame
                frame = _showing(frame, self._frozen.image, self._frozen.jpeg)
        if delay_us or self._late:
            # A camera's frames arrive in order: a later frame must not overtake.
            due_us = frame.capture_time_us + delay_us
            self._late.append((max(due_us, self._late[-1][0]) if self._late else due_us, frame))
        else:
            publish(frame)

    def _rearrange(self) -> None:
        self._acting = self._timeline.acting("camera")
        if all(each.fault.kind != "stuck" for each in self._acting):
            self._frozen = None


def _showing(frame: Frame, image: NDArray[Any], jpeg: bytes | None) -> Frame:
    """Return a copy of a frame with another image of the main camera."""
    shown = image, frame.intrinsics, jpeg, frame.further
    return Frame(frame.sequence, frame.capture_time_us, *shown)
