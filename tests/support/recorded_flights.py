"""Flights with known truth, recorded as on an aircraft: black box and vehicle's log.

They are flown in lockstep, so that they are the same every time. A companion in lockstep receives
nothing between its turns. Here its black box samples the flight controller's messages at the rate
of MAVSDK's telemetry, as on a companion in real time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import US_PER_S
from airl_mav.lockstep.stage import LockstepStage
from airl_mav.policy.observation import Kinematics
from airl_mav.profiles.vehicle import VehicleProfile
from airl_mav.rehearsal.episode import part_of
from airl_mav.scenario.checks import TRANSPORT_US
from airl_mav.scenario.resolve import ResolvedScenario
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.addons.black_box.recorder import SAMPLE_US, open_recorder, run_of
from companion.link_interface import BatteryState, VehicleStatus
from companion.mavsdk_link import MavsdkLink
from companion.pilot import Mission, fly_mission
from companion.program import prepare
from firmware_sim.simulation import EpisodeSetup, Simulation

TELEMETRY_US = US_PER_S // 50
"""Interval of MAVSDK's telemetry, requested at 50 Hz (companion.mavsdk_link)."""


@dataclass(frozen=True)
class RecordedFlight:
    """Files of a flight, and its known truth."""

    black_box: Path
    ulg: Path
    reason: str
    truth: dict[str, NDArray[Any]]
    """The simulator's arrays: `trajectory/...`, `setpoints/...`."""

    def part(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the arrays of a part."""
        return part_of(self.truth, name)


AGE_US = 8_000
"""Age of the telemetry that the black box samples: anywhere from 0 to 20 ms where it has a clock of
its own, here a multiple of the tick [µs]."""


class HeardLink:
    """Link for the black box: telemetry sampled when it is sent, not when it is received."""

    def __init__(self, link: MavsdkLink) -> None:
        self._link = link
        self.simulation: Simulation | None = None
        self._at_us = -1
        self._heard = Kinematics(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    def listen(self, simulation: Simulation) -> None:
        """Take what the flight controller sends now."""
        self.simulation = simulation
        if simulation.time_us % TELEMETRY_US == 0 and simulation.autopilot.internals is not None:
            estimate = simulation.autopilot.internals.state().estimate
            self._heard = Kinematics(
                estimate.position.copy(), estimate.velocity.copy(), estimate.quaternion.copy()
            )

    def kinematics(self) -> Kinematics:
        return self._heard

    def status(self) -> VehicleStatus:
        return self._link.status()

    def battery(self) -> BatteryState:
        return self._link.battery()


def fly_recorded(
    scenario: ResolvedScenario,
    seed: int,
    folder: Path,
    *,
    vehicle: VehicleProfile | None = None,
) -> RecordedFlight:
    """Fly an episode with a black box and the vehicle's log.

    Args:
        scenario: The companion's assumed aircraft, and the other settings.
        seed: Seed of the episode.
        folder: New; the files come into it.
        vehicle: True vehicle; None = the scenario's.
    """
    folder.mkdir(parents=True, exist_ok=True)
    asked = scenario.scenario
    arena = scenario.arena_of(seed)
    goal = (float(arena.goal[0]), float(arena.goal[1]))
    alone = StandAloneCompanion(
        policy=asked.policy,
        goal=goal,
        seed=seed,
        vehicle=asked.vehicle,
        black_box=folder,
        latency=asked.latency,
        black_box_images_hz=0.0,
    )
    run = run_of(alone, prepare(alone))
    setup = EpisodeSetup(vehicle or scenario.vehicle, arena, seed, asked)
    reasons: list[str] = []
    with LockstepStage(transport_us=TRANSPORT_US, faults=asked.faults) as stage:
        heard = HeardLink(stage.link)
        recorder = open_recorder(folder, run, heard, stage.clock, goal)
        phases: list[str] = []

        def look_on(simulation: Simulation) -> None:
            heard.listen(simulation)
            if simulation.time_us % SAMPLE_US == AGE_US and phases and not reasons:
                recorder.record(simulation.time_us)

        def phase(name: str) -> None:
            phases.append(name)
            recorder.phase(name)

        def program() -> None:
            mission = Mission(
                goal,
                scenario.fresh_policy(seed),
                scenario.companion_pilot,
                scenario.watchdog,
                asked.limits,
                scenario.latency_sampler(seed, native=False),
            )
            link, frames, clock, stop = stage.link, stage.camera, stage.clock, stage.abandon
            decided = recorder.decided
            result = fly_mission(link, frames, mission, clock, stop, stop, phase, clock, decided)
            reasons.append(result.reason)

        stage.firmware.on_tick = look_on
        simulation = stage.run(setup, program, tlog=folder / "flight.tlog")
        stage.firmware.close_logs()
        recorder.end(reasons[0], ())
        truth = simulation.arrays()
    (black_box,) = folder.glob("*.mcap")
    return RecordedFlight(black_box, folder / "flight.ulg", reasons[0], truth)
