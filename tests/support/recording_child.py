"""Process that records a flight until it is killed, and reports its decisions.

    python -m tests.support.recording_child FILE

The path is synthetic: the tests check the black box, and how much of it a kill leaves.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from airl_mav.black_box.mcap_file import BlackBoxFile
from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import Clock, WallClock
from airl_mav.core.constants import US_PER_MS
from airl_mav.policy.observation import Kinematics
from companion.addons.black_box.recorder import BlackBoxRecorder
from companion.frame_source import ReceivedFrame
from companion.link_interface import BatteryState, BodyVelocity, VehicleStatus
from companion.pilot import SentDecision

LENS = Intrinsics.from_fov(64, 48, 1.0)
PERIOD_US = 20 * US_PER_MS


class Straight:
    """Flies north at 1 m/s."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def kinematics(self) -> Kinematics:
        north = self._clock.time_us() / 1e6
        return Kinematics(
            np.array([north, 0.0, -2.5]), np.array([1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
        )

    def status(self) -> VehicleStatus:
        return VehicleStatus(True, True, "offboard")

    def battery(self) -> BatteryState:
        return BatteryState(16.0, 10.0, 0.8)


def main(path: Path) -> None:
    clock = WallClock()
    link = Straight(clock)
    recorder = BlackBoxRecorder(BlackBoxFile(path, {}), link, clock, (1000.0, 0.0), 10.0)
    recorder.start()
    number = 0
    while True:
        number += 1
        now_us = clock.time_us()
        depth = np.full((48, 64), number % 20_000, np.uint16)
        seen = ReceivedFrame(Frame(number, now_us, depth, LENS), now_us)
        times = now_us, now_us, now_us, now_us + PERIOD_US, now_us
        command = BodyVelocity(1.0, 0.0, 0.0, 0.0)
        recorder.decided(SentDecision(seen, link.kinematics(), command, *times, None, depth))
        sys.stdout.write(f"{now_us}\n")
        sys.stdout.flush()
        clock.sleep_until(now_us + PERIOD_US)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
