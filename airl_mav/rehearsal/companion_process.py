"""Companion process of a rehearsal: MAVSDK, camera and policy fly missions on request."""

from __future__ import annotations

import os
import queue
import sys
import threading
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import LOOPBACK
from airl_mav.core.errors import EXIT_BROKEN
from airl_mav.core.files import save_arrays
from airl_mav.core.resource_use import UseMeter
from airl_mav.core.signing import camera_key
from airl_mav.rehearsal import channel
from airl_mav.rehearsal.live_view import view_part
from airl_mav.scenario.resolve import ResolvedScenario
from companion.frame_source import open_camera
from companion.link_interface import LinkError
from companion.mavsdk_link import MavsdkLink
from companion.pilot import Mission, check_camera, fly_mission
from companion.watchdog import ThreadGuard

CONNECT_TIMEOUT_S = 30.0
"""Connection timeout of the flight controller [wall s]."""


class MissionRunner:
    """Flies missions; link and camera stay open between them."""

    def __init__(
        self,
        scenario: ResolvedScenario,
        harness: channel.ChildChannel,
        tap: Any = None,
    ) -> None:
        """Load the policy without connecting. Raises UsageError."""
        self._scenario = scenario
        self._tap = tap
        self._harness = harness
        self._clock = WallClock(scenario.speed or 1.0)
        self._requests: queue.Queue[Any] = queue.Queue()
        self._stop, self._abandon = threading.Event(), threading.Event()

    def handle(self, request: Any) -> None:
        """Accept a request, on the channel's thread."""
        if isinstance(request, channel.Abort):
            (self._stop if request.land else self._abandon).set()
            self._stop.set()
            return
        if isinstance(request, channel.Fly):
            self._stop.clear()
            self._abandon.clear()
            # Set once per flight: holding an action and the watchdog must not jump when the
            # simulator skips time. The rehearsal corrects the stamps afterwards.
            if request.epoch_ns is not None:
                self._clock.epoch_ns = request.epoch_ns
        self._requests.put(request)

    def run(self) -> None:
        """Fly the requested missions until shutdown. Raises UsageError for an unfit camera."""
        aircraft, clock = self._scenario.scenario, self._clock
        endpoint = f"tcp://{LOOPBACK}:{aircraft.open_ports.camera_port}"
        key = camera_key(aircraft.camera_key, endpoint, "camera")
        use = UseMeter(WallClock())
        self._scenario.fresh_policy(aircraft.seed)  # loaded before the first flight
        compensator = self._scenario.compensator()
        with (
            closing(open_camera(endpoint, clock, key)) as frames,
            closing(
                MavsdkLink(
                    *(f"udpin://{LOOPBACK}:{aircraft.companion_port}", clock, self._abandon),
                    signing_key=aircraft.signing_key,
                    system_id=aircraft.system_id,
                )
            ) as link,
        ):
            self._harness.send(channel.Ready())
            while not isinstance(request := self._requests.get(), channel.Shutdown):
                if not link.connected:
                    link.connect(CONNECT_TIMEOUT_S)
                policy = self._scenario.fresh_policy(request.seed)
                check_camera(policy, frames, self._stop, compensator)
                latency = self._scenario.latency_sampler(request.seed, native=True)
                carries, decided, tap = compensator, None, self._tap
                if tap is not None:
                    tap.begin()
                    latency, carries = tap.latency(latency), tap.compensator()
                    decided = tap.decided
                use.begin()
                mission = Mission.of(self._scenario, request.goal, policy, latency, carries)
                stop, abandon, guard = self._stop, self._abandon, ThreadGuard(clock)
                result = fly_mission(
                    link, frames, mission, clock, stop, abandon, self._announce, guard, decided
                )
                used = use.end()
                save_arrays(Path(request.record), result.log.columns())
                self._harness.send(
                    channel.Ended(
                        reason=result.reason,
                        notes=result.notes,
                        by_hand=tap is not None and tap.touched,
                        use=used,
                    )
                )

    def _announce(self, phase: str) -> None:
        self._harness.send(channel.PhaseEntered(phase=phase, time_us=self._clock.time_us()))


def fly(begin: channel.Begin, harness: channel.ChildChannel) -> None:
    """Fly missions on request until the pipe closes."""
    with ExitStack() as held:
        tap: Any = None
        if begin.view is not None:
            tap = held.enter_context(closing(view_part("companion")(begin.view, begin.scenario)))
        missions = MissionRunner(begin.scenario, harness, tap)
        # Without its rehearsal the companion must not fly: its setpoints end and the flight
        # controller's offboard-loss failsafe takes over.
        harness.listen(missions.handle, lambda: os._exit(EXIT_BROKEN))
        missions.run()


if __name__ == "__main__":
    sys.exit(channel.serve(fly, LinkError))
