"""The companion's behaviour at its limits: flights in lockstep, with the real MAVSDK."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from airl_mav.core.constants import US_PER_S
from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.lockstep.stage import LockstepStage
from airl_mav.policy.actions import Action
from airl_mav.policy.observation import Observation
from airl_mav.rehearsal.run_folder import FlownEpisode
from airl_mav.scenario.checks import TRANSPORT_US
from companion.pilot import MissionResult
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.lockstep_kit import demo_scenario, fly_as_companion

FAR_SEED = 3
"""A flight of several seconds."""


class Creeps:
    """Flies ahead slowly, and never arrives."""

    def __init__(self, begins: Callable[[], None] = lambda: None) -> None:
        """Take what is called with every decision."""
        self._begins = begins

    def act(self, observation: Observation) -> Action:
        self._begins()
        return Action(0.5, 0.0, 0.0)


def flown(**changes: object) -> FlownEpisode:
    scenario = demo_scenario(policy="greedy", **changes)
    return fly(scenario, scenario.fresh_policy(FAR_SEED), 0, FAR_SEED)


@pytest.mark.parametrize(
    ("mode", "breaks"), [(Mode.HOLD, False), (Mode.RETURN, False), (Mode.HOLD, True)]
)
def test_who_takes_over_has_the_vehicle(mode: Mode, breaks: bool) -> None:
    """Within one heartbeat the companion stops sending setpoints and mode requests."""
    scenario = demo_scenario(policy="greedy")
    setup = EpisodeSetup(scenario.vehicle, scenario.arena_of(FAR_SEED), FAR_SEED)
    results: list[MissionResult] = []
    modes: list[tuple[Mode, int]] = []
    """Flown modes, each with its start [µs]."""

    with LockstepStage(transport_us=TRANSPORT_US) as stage:

        def break_after_a_long_thought() -> None:
            now_us = stage.clock.time_us()
            if breaks and modes[-1][0] is Mode.OFFBOARD and now_us - modes[-1][1] > 2 * US_PER_S:
                stage.clock.sleep_until(now_us + 19 * US_PER_S // 10)
                if modes[-1][0] is mode:
                    raise ZeroDivisionError

        def take_over(simulation: Simulation) -> None:
            autopilot = simulation.autopilot
            assert isinstance(autopilot, BuiltinAutopilot)
            flown = autopilot.flight.mode
            if not modes or modes[-1][0] is not flown:
                modes.append((flown, simulation.time_us))
            if flown is Mode.OFFBOARD and simulation.time_us - modes[-1][1] > 3 * US_PER_S:
                autopilot.set_mode(mode)

        stage.firmware.on_tick = take_over

        policy = Creeps(break_after_a_long_thought)

        def program() -> None:
            results.append(fly_as_companion(stage, policy, (500.0, 0.0)))

        simulation = stage.run(setup, program)
        until_us = simulation.time_us + 3 * US_PER_S
        while simulation.time_us < until_us:
            stage.firmware.step()
        assert simulation.recorder is not None
        accepted_us = simulation.recorder.setpoints.arrays()["accepted_us"]
        assert simulation.autopilot.flight.phase is FlightPhase.AIR
    (result,) = results
    assert result.reason == ("policy failed: ZeroDivisionError:" if breaks else "taken over")
    assert result.notes[-1].startswith("taken over: the mode is ")
    assert [each for each, _ in modes[-2:]] == [Mode.OFFBOARD, mode]
    assert accepted_us.max() <= modes[-1][1] + US_PER_S + US_PER_S // 2


def test_a_picture_that_stays_is_not_flown_on() -> None:
    record = flown(faults=("camera stuck at offboard+500ms",)).record
    assert record.outcome is Outcome.ABORTED
    assert "camera frozen" in record.reason
    assert any("the image has not changed for" in note for note in record.notes)


def test_telemetry_that_stays_is_not_flown_on() -> None:
    """The vehicle still hears the companion: Hold is requested, and no answer arrives."""
    record = flown(faults=("downlink cut at offboard+500ms",)).record
    assert record.outcome is Outcome.ABORTED
    assert "link lost" in record.reason
    notes = "; ".join(record.notes)
    assert "telemetry frozen: position has not changed for 2." in notes
    assert "leaving offboard failed" in notes
