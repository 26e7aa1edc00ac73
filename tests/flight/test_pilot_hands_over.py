"""A pilot takes off, hands over by switching to Offboard, and gets the vehicle back in Hold.

In lockstep, with the real MAVSDK; the pilot's switches are the flight controller's own doors.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.constants import US_PER_S
from airl_mav.lockstep.stage import LockstepStage
from airl_mav.policy.actions import Action
from airl_mav.policy.observation import Observation
from airl_mav.scenario.checks import TRANSPORT_US
from airl_mav.scenario.model import PilotSettings
from companion.pilot import MissionResult
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.lockstep_kit import demo_scenario, fly_as_companion
from tests.support.ports import LOOPBACK, choose_ports
from tests.support.processes import ground_station, running, wait_until

SEED = 3
AHEAD_M = 8.0


def fly_ahead(observation: Observation) -> Action:
    bearing = observation.goal_bearing
    return Action(2.0 * math.cos(bearing), 2.0 * math.sin(bearing), 0.0)


@dataclass
class Deciding:
    """A policy that is a function."""

    act: Callable[[Observation], Action]


@dataclass
class Flight:
    """Results of a flight."""

    result: MissionResult
    simulation: Simulation
    modes: list[Mode]
    """Modes in the order flown."""
    phases: list[str]
    """Phases of the companion."""
    refused: list[Result]
    """The pilot's switches that were not taken."""

    @property
    def autopilot(self) -> BuiltinAutopilot:
        autopilot = self.simulation.autopilot
        assert isinstance(autopilot, BuiltinAutopilot)
        return autopilot


def fly_with(
    pilot: Callable[[BuiltinAutopilot, float], Result | None],
    *,
    stop_at_s: float = math.inf,
    act: Callable[[Observation], Action] = fly_ahead,
) -> Flight:
    """Fly with a pilot called 4 times a second with the time since the start [s]."""
    scenario = demo_scenario(policy="greedy")
    setup = EpisodeSetup(scenario.vehicle, scenario.arena_of(SEED), SEED)
    results: list[MissionResult] = []
    modes: list[Mode] = []
    phases: list[str] = []
    refused: list[Result] = []
    stop = threading.Event()
    with LockstepStage(transport_us=TRANSPORT_US) as stage:

        def look_on(simulation: Simulation) -> None:
            autopilot = simulation.autopilot
            assert isinstance(autopilot, BuiltinAutopilot)
            if not modes or modes[-1] is not autopilot.flight.mode:
                modes.append(autopilot.flight.mode)
            if simulation.time_us % (US_PER_S // 4) == 0:
                result = pilot(autopilot, simulation.time_us / US_PER_S)
                if result is not None and result is not Result.ACCEPTED:
                    refused.append(result)
            if simulation.time_us >= stop_at_s * US_PER_S:
                stop.set()

        stage.firmware.on_tick = look_on

        def program() -> None:
            policy, goal = Deciding(act), (AHEAD_M, 0.0)
            results.append(
                fly_as_companion(
                    stage, policy, goal, stop=stop, phase=phases.append, start="offboard"
                )
            )

        simulation = stage.run(setup, program)
        until_us = simulation.time_us + 2 * US_PER_S
        while simulation.time_us < until_us:
            stage.firmware.step()
    (result,) = results
    return Flight(result, simulation, modes, phases, refused)


def take_off_and_hand_over(autopilot: BuiltinAutopilot, now_s: float) -> Result | None:
    """Take off when it can be armed; switch to Offboard once it holds."""
    flight = autopilot.flight
    if flight.phase is FlightPhase.STANDBY:
        if now_s > 8.0 or autopilot.arm(force=False) is not Result.ACCEPTED:
            return None
        return autopilot.takeoff(2.5)
    if flight.phase is FlightPhase.AIR and flight.mode is Mode.HOLD and now_s < 20.0:
        return autopilot.set_mode(Mode.OFFBOARD)
    return None


class Once:
    """A pilot who hands over once, and may take back."""

    def __init__(self, take_back_after_s: float = math.inf) -> None:
        self.handed_over_s = math.inf
        self.take_back_after_s = take_back_after_s

    def __call__(self, autopilot: BuiltinAutopilot, now_s: float) -> Result | None:
        if now_s < self.handed_over_s:
            result = take_off_and_hand_over(autopilot, now_s)
            if autopilot.flight.mode is Mode.OFFBOARD:
                self.handed_over_s = now_s
            return result
        if now_s > self.handed_over_s + self.take_back_after_s:
            self.take_back_after_s = math.inf
            return autopilot.set_mode(Mode.HOLD)
        return None


def test_the_goal_is_reached_and_the_pilot_has_it_back_in_hold() -> None:
    flight = fly_with(Once())
    assert flight.result.reason == "goal reached"
    assert flight.phases == ["waiting for offboard", "navigating", "handing back", "done"]
    assert flight.modes[-3:] == [Mode.HOLD, Mode.OFFBOARD, Mode.HOLD]
    assert flight.autopilot.flight.phase is FlightPhase.AIR, "it never lands"
    north, east, _ = flight.autopilot.state().estimate.position
    assert math.hypot(north - AHEAD_M, east) < PilotSettings.goal_radius_m + 0.5
    assert not flight.refused, "zero setpoints were there before the switch"


def test_a_pilot_takes_back_what_he_gave() -> None:
    flight = fly_with(Once(take_back_after_s=1.0))
    assert flight.result.reason == "taken over"
    assert flight.modes[-1] is Mode.HOLD
    assert "handing back" not in flight.phases


def test_a_policy_that_fails_leaves_the_vehicle_in_hold() -> None:
    def fail(_: Observation) -> Action:
        raise ZeroDivisionError

    flight = fly_with(Once(), act=fail)
    assert flight.result.reason.startswith("policy failed: ZeroDivisionError")
    assert flight.modes[-2:] == [Mode.OFFBOARD, Mode.HOLD]
    assert flight.autopilot.flight.phase is FlightPhase.AIR


def test_on_the_ground_nothing_begins() -> None:
    def switch(autopilot: BuiltinAutopilot, now_s: float) -> Result | None:
        if autopilot.flight.phase is FlightPhase.STANDBY and now_s < 8.0:
            autopilot.arm(force=False)
            autopilot.set_mode(Mode.OFFBOARD)
        return None

    flight = fly_with(switch, stop_at_s=12.0)
    assert Mode.OFFBOARD in flight.modes
    assert flight.result.reason == "stopped"
    assert flight.phases == ["waiting for offboard", "done"]
    assert len(flight.result.log) == 0


def test_after_the_wait_was_ended_no_switch_is_taken() -> None:
    """Nothing is repeated behind the companion's back."""
    stop_at_s = 6.0

    def late(autopilot: BuiltinAutopilot, now_s: float) -> Result | None:
        if now_s < stop_at_s:
            if autopilot.flight.phase is FlightPhase.STANDBY:
                autopilot.arm(force=False)
                autopilot.takeoff(2.5)
            return None
        return autopilot.set_mode(Mode.OFFBOARD) if now_s > stop_at_s + 1.0 else None

    flight = fly_with(late, stop_at_s=stop_at_s)
    assert flight.result.reason == "stopped"
    assert Mode.OFFBOARD not in flight.modes
    assert flight.refused


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.xdist_group("flight")
@pytest.mark.timeout(300)
def test_the_program_tells_the_ground_station_and_waits_for_the_switch(tmp_path: Path) -> None:
    """Run two programs over UDP, with a ground station for the pilot."""
    with ground_station() as ground:
        ports = choose_ports(gcs=ground.port)
        firmware = ["-m", "airl_mav.cli.firmware_command", "--arena", "open-field", "--speed", "2"]
        companion = [
            *("-m", "airl_mav.cli.companion_command", "--policy", "greedy", "--goal", "9", "0"),
            *("--start", "offboard", "--speed", "2"),
            *("--connect", f"udpin://{LOOPBACK}:{ports.api}"),
            *("--camera", f"tcp://{LOOPBACK}:{ports.camera}"),
        ]

        def command(number: int, *parameters: float) -> None:
            filled = (*parameters, *(7 - len(parameters)) * (math.nan,))
            ground.send(
                dialect.MAVLink_command_long_message(1, 1, number, 0, *filled), ports.gcs_local
            )

        with running([*firmware, *ports.options()], tmp_path) as vehicle:
            vehicle.wait_for_text("Ctrl-C ends it")
            # Broadcasts require a message from the receiver first.
            station = dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3
            ground.send(dialect.MAVLink_heartbeat_message(*station), ports.gcs_local)
            with running(companion, tmp_path) as program:
                wait_until(lambda: ground.heard("airl: waiting for offboard"), "the text")
                command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
                command(dialect.MAV_CMD_NAV_TAKEOFF)
                wait_until(lambda: ground.height > 2.0, "the take-off")
                command(dialect.MAV_CMD_DO_SET_MODE, 1, 6)
                assert program.wait(120.0) == 0, program.text()
            wait_until(lambda: ground.heard("airl: goal reached"), "the last text")
            assert ground.armed
            computer = ground.latest["ONBOARD_COMPUTER_STATUS"]
            told = [load for load in computer.cpu_cores if load != 255]
            assert len(told) == min(8, psutil.cpu_count())
            assert max(told) <= 100
            assert computer.ram_total == psutil.virtual_memory().total // 2**20
            assert 0 < computer.ram_usage < computer.ram_total
            # MAVSDK's component of a companion computer.
            assert computer.get_srcComponent() == dialect.MAV_COMP_ID_PATHPLANNER
