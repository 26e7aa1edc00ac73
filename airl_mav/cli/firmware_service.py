"""`airl-firmware --control stdio`: episodes on request of a harness."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from airl_mav.core.clock import utc_now
from airl_mav.core.constants import US_PER_S
from airl_mav.rehearsal.channel import (
    ChildChannel,
    FinishEpisode,
    Loaded,
    LoadEpisode,
    Saved,
    Shutdown,
    Text,
)
from airl_mav.rehearsal.state import state_of
from firmware_sim import firmware
from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.crash_detector import CrashDetector
from firmware_sim.simulation import EpisodeSetup, Simulation

STATE_EVERY_US = 40_000
"""The harness hears the true state so often: 25 Hz."""


class Bench(Protocol):
    """What flies the episodes, one at a time."""

    @property
    def camera_endpoint(self) -> str:
        """Where frames are published."""
        ...

    @property
    def slipped_us(self) -> int:
        """Simulated time given up since the start because the host could not keep up [µs]."""
        ...

    @property
    def time_us(self) -> int:
        """Simulated time of the newest tick [µs]."""
        ...

    @property
    def idle(self) -> bool:
        """Whether there is nothing to fly before the next request."""
        ...

    def load(
        self,
        setup: EpisodeSetup,
        tlog: Path | None,
        tick: Callable[[Simulation], None],
        text: Callable[[Message], None],
    ) -> firmware.Loaded:
        """Set up an episode; `tick` is called after every tick, `text` with what is said."""
        ...

    def step(self) -> None:
        """Fly a tick."""
        ...

    def finish(self, record: Path) -> dict[str, str]:
        """Save the episode's arrays and forget it; return its fingerprint, if it has one."""
        ...

    def close(self) -> None:
        """Release everything."""
        ...


class WallBench:
    """Level with the wall clock: one firmware for all episodes. Implements `Bench`."""

    idle = False

    def __init__(self, flown: firmware.Firmware) -> None:
        self._firmware = flown

    @property
    def camera_endpoint(self) -> str:
        """Where frames are published."""
        return self._firmware.camera_endpoint

    @property
    def slipped_us(self) -> int:
        """Simulated time given up since the start because the host could not keep up [µs]."""
        return self._firmware.slipped_us

    @property
    def time_us(self) -> int:
        """Simulated time of the newest tick [µs]."""
        simulation = self._firmware.simulation
        return 0 if simulation is None else simulation.time_us

    def load(
        self,
        setup: EpisodeSetup,
        tlog: Path | None,
        tick: Callable[[Simulation], None],
        text: Callable[[Message], None],
    ) -> firmware.Loaded:
        """Set up an episode; see `Bench`."""
        self._firmware.on_tick = tick
        self._firmware.on_message = text
        return self._firmware.load(setup, tlog, unix_us())

    def step(self) -> None:
        """Fly a tick."""
        self._firmware.step()

    def finish(self, record: Path) -> dict[str, str]:
        """Save the episode's arrays and forget it."""
        self._firmware.save(record)
        self._firmware.discard()
        return {}

    def close(self) -> None:
        """Release everything."""
        self._firmware.close()


class Service:
    """Requests of the harness on a bench."""

    def __init__(
        self,
        bench: Bench,
        channel: ChildChannel,
        setup: Callable[[LoadEpisode], EpisodeSetup],
    ) -> None:
        """Take what flies, whom to tell, and what makes an episode of a request."""
        self._bench = bench
        self._channel = channel
        self._setup = setup
        self._record = Path()
        self._reported = 0
        self._crash = CrashDetector()
        self._handlers: dict[type, Callable[[Any], None]] = {
            LoadEpisode: self._load,
            FinishEpisode: self._finish,
        }

    def run(self, requests: queue.Queue[Any]) -> None:
        """Fly until it is time to end.

        Raises:
            UsageError: An episode cannot be made.
            LockstepError: The companion does not keep to the turns.
        """
        while self._handle_all(requests):
            if not self._bench.idle:
                self._bench.step()

    def _handle_all(self, requests: queue.Queue[Any]) -> bool:
        """Handle what has arrived; False when it is time to end."""
        with contextlib.suppress(queue.Empty):
            while True:
                request = requests.get(block=self._bench.idle)
                if isinstance(request, Shutdown):
                    return False
                self._handlers[type(request)](request)
        return True

    def _load(self, request: LoadEpisode) -> None:
        episode = self._setup(request)
        tlog = Path(request.tlog) if request.tlog else None
        self._crash = CrashDetector()
        loaded = self._bench.load(episode, tlog, self._report, self._tell)
        self._record = Path(request.record)
        goal = episode.arena.goal if episode.arena is not None else np.zeros(2)
        self._channel.send(
            Loaded(
                episode=request.episode,
                time_us=loaded.time_us,
                epoch_ns=loaded.epoch_ns,
                slipped_us=self._bench.slipped_us,
                goal=(float(goal[0]), float(goal[1])),
            )
        )

    def _finish(self, _: FinishEpisode) -> None:
        sha256 = self._bench.finish(self._record)
        self._channel.send(Saved(path=str(self._record), sha256=sha256))

    def _report(self, simulation: Simulation) -> None:
        period = simulation.time_us // STATE_EVERY_US
        if not self._crash.look(simulation) and period == self._reported:
            return
        self._reported = period
        self._channel.send(state_of(simulation, self._crash.hit, self._bench.slipped_us))

    def _tell(self, message: Message) -> None:
        time_us = self._bench.time_us
        self._channel.send(Text(time_us=time_us, severity=int(message.severity), text=message.text))


def unix_us() -> int:
    """Return the calendar time [µs since 1970], for log headers."""
    return int(utc_now().timestamp() * US_PER_S)
