"""Recording in the firmware process: everything for a harness, nothing stand alone."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from airl_mav.core.constants import TICK_US
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Setpoint
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.firmware import BuiltinFlightStack, Firmware
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.pacing import MAX_LAG_US, Pacing, Unpaced, WallPacing
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.flight_rig import quad, velocity_setpoint

TICKS_A_MINUTE = 60 * 250


class Mute(MemoryEndpoint):
    """Endpoint that discards streams."""

    def send_streams(self, frames: Sequence[bytes]) -> None:
        del frames


def firmware(pacing: Pacing, *, recording: bool) -> Firmware:
    server = MavlinkServer([onboard_link(Mute())], boot_unix_us=0)
    return Firmware(BuiltinFlightStack(server), None, pacing, recording=recording)


def simulated(flown: Firmware) -> Simulation:
    assert flown.simulation is not None
    return flown.simulation


def autopilot_of(flown: Firmware) -> BuiltinAutopilot:
    autopilot = simulated(flown).autopilot
    assert isinstance(autopilot, BuiltinAutopilot)
    return autopilot


def fly(flown: Firmware, ticks: int, setpoint: Setpoint | None = None) -> None:
    """Fly on; with a setpoint, streamed at 25 Hz."""
    for i in range(ticks):
        if setpoint is not None and i % 10 == 0:
            autopilot_of(flown).offer_setpoint(setpoint, flown.clock.time_us())
        flown.step()


class Preempted(WallPacing):
    """The process loses the processor between the clock and the sockets."""

    def wait(self, tick_us: int, sockets: Sequence[int], readable: Callable[[int], object]) -> int:
        began_us = super().wait(tick_us, sockets, readable)
        time.sleep(0.003)
        return began_us


def test_a_setpoint_is_not_accepted_before_it_was_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    flown = firmware(Preempted(1.0), recording=True)
    flown.load(EpisodeSetup(quad(), None, 1), None, 0)
    sent_us: list[int] = []
    setpoint = velocity_setpoint(1.0, 0.0, 0.0, yaw=float("nan"), yaw_rate=0.0)
    receive = flown.flight_stack.receive

    def arrive_now(now_us: int) -> None:
        sent_us.append(flown.clock.time_us())
        autopilot_of(flown).offer_setpoint(setpoint, now_us)
        receive(now_us)

    monkeypatch.setattr(flown.flight_stack, "receive", arrive_now)
    fly(flown, 10)
    log = simulated(flown).arrays()
    flown.close()
    accepted_us, motor_us = log["setpoints/accepted_us"], log["setpoints/motor_us"]
    assert len(accepted_us) >= 5
    assert np.all(accepted_us >= sent_us[: len(accepted_us)])
    assert np.all(np.diff(accepted_us) >= 0)
    assert np.all(motor_us >= accepted_us)


def blocks_kept_by_two_minutes(*, recording: bool) -> int:
    """Return how many memory blocks two minutes of an offboard flight leave behind."""
    flown = firmware(Unpaced(), recording=recording)
    circle = velocity_setpoint(1.0, 0.0, -0.01, yaw=float("nan"), yaw_rate=0.3)
    flown.load(EpisodeSetup(quad(), None, 1), None, 0)
    autopilot = autopilot_of(flown)
    fly(flown, 4 * 250)
    assert autopilot.arm(force=False) == 0
    autopilot.takeoff(5.0)
    fly(flown, 15 * 250, circle)
    assert autopilot.set_mode(Mode.OFFBOARD) == 0
    fly(flown, 15 * 250, circle)
    gc.collect()
    before = sys.getallocatedblocks()
    fly(flown, 2 * TICKS_A_MINUTE, circle)
    gc.collect()
    kept = sys.getallocatedblocks() - before
    assert autopilot.flight.mode is Mode.OFFBOARD
    flown.close()
    return kept


@pytest.mark.nightly
def test_memory_stays_bounded_where_nobody_collects_the_record() -> None:
    assert blocks_kept_by_two_minutes(recording=False) < 200


@pytest.mark.nightly  # Recorded data: test_simulation.py.
def test_the_same_flight_recorded_keeps_its_samples() -> None:
    assert blocks_kept_by_two_minutes(recording=True) > 6_000


def test_collisions_of_a_flight_that_is_not_recorded_are_forgotten() -> None:
    flown = firmware(Unpaced(), recording=False)
    flown.load(EpisodeSetup(quad(), None, 1), None, 0)
    autopilot = autopilot_of(flown)
    fly(flown, 4 * 250)
    autopilot.arm(force=False)
    autopilot.takeoff(3.0)
    fly(flown, 6 * 250)
    autopilot.disarm(force=True)
    fell = 0
    for _ in range(3 * 250):
        flown.step()
        fell += len(simulated(flown).plant.collisions)
    assert fell >= 1, "it fell from 3 m"
    assert simulated(flown).plant.collisions == []
    flown.close()


def test_what_the_host_gave_up_is_saved_with_the_ticks(tmp_path: Path) -> None:
    """Against the pacing's own account, at a hundred times real time: 10 ms are a second."""
    flown = firmware(WallPacing(100.0), recording=True)
    flown.load(EpisodeSetup(quad(), None, 1), None, 0)
    first_us = simulated(flown).time_us
    for pause_s in (0.0, 0.03, 0.0):
        time.sleep(pause_s)
        flown.step()
    lost_us = flown.slipped_us
    flown.save(tmp_path / "record.npz")
    flown.close()
    with np.load(tmp_path / "record.npz") as record:
        lateness, slips = record["tick/lateness_us"], record["tick/slips_us"]
        ticks = record["trajectory/time_us"]
    assert lateness.shape == (3,)
    assert (lateness >= 0).all()
    assert (lateness <= MAX_LAG_US).all()
    assert slips[:, 1].sum() == lost_us
    assert any(when >= first_us + TICK_US and lost > MAX_LAG_US for when, lost in slips)
    assert ticks[0] == first_us


@pytest.mark.parametrize("recording", [True, False])
def test_an_unpaced_flight_has_no_late_ticks(tmp_path: Path, recording: bool) -> None:
    flown = firmware(Unpaced(), recording=recording)
    flown.load(EpisodeSetup(quad(), None, 1), None, 0)
    fly(flown, 20)
    assert (simulated(flown).recorder is not None) is recording
    if recording:
        arrays = simulated(flown).arrays()
        assert arrays["tick/lateness_us"].shape == (0,)
        assert arrays["tick/slips_us"].shape == (0, 2)
    flown.close()
