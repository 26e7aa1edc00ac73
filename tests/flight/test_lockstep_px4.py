"""PX4 in lockstep with the companion: its stand-in, and the real one where there is one.

    AIRL_PX4_DIR=PX4-Autopilot pytest tests/flight/test_lockstep_px4.py

flies the PX4 of that folder as well: a SITL build, its source tree, or an unpacked package.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.experiments.experiment import rehearse
from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.lockstep.stage import LockstepStage
from airl_mav.lockstep.turns import LockstepError
from airl_mav.lockstep.vehicle import ConductedVehicle, VehicleEnd, acknowledged, builtin_vehicle
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve
from firmware_sim.interfaces import FirmwareLostError
from firmware_sim.simulation import EpisodeSetup
from tests.support.processes import write_arena
from tests.support.px4_peer import write_build

SEED = 11
REAL = os.environ.get("AIRL_PX4_DIR")


class LateAnswers:
    """The built-in autopilot, whose answers to commands take simulated time. A `VehicleEnd`."""

    answers_later = True

    def __init__(self, end: VehicleEnd, ticks: int) -> None:
        self.end, self.ticks = end, ticks
        self.held: list[tuple[int, bytes]] = []
        self.looked = self.waited = self.echoes = 0

    def deliver(self, frame: bytes, carry_out: Callable[[], object], *, echo: bool) -> None:
        self.end.deliver(frame, carry_out, echo=echo)
        self.echoes += echo

    def take(self) -> list[bytes]:
        self.looked += 1
        due = [frame for at, frame in self.held if at <= self.looked]
        self.held = [(at, frame) for at, frame in self.held if at > self.looked]
        passed = []
        for frame in self.end.take():
            if acknowledged(frame) is None:
                passed.append(frame)
            else:
                self.held.append((self.looked + self.ticks, frame))
                self.waited += 1
        return [*passed, *due]

    def after_tick(self, *, expected: bool) -> list[bytes]:
        del expected
        return self.take()

    def settle(self) -> None:
        self.end.settle()


def late(ticks: int) -> tuple[LateAnswers, ConductedVehicle]:
    vehicle = builtin_vehicle(SimClock())
    end = LateAnswers(vehicle.end, ticks)
    return end, ConductedVehicle(vehicle.stack, end)


def test_simulated_time_goes_on_while_a_command_is_answered() -> None:
    """The companion waits inside MAVSDK; it takes off, flies and comes down all the same."""
    end, vehicle = late(3)
    flown_us: list[int] = []
    with LockstepStage(vehicle=vehicle) as stage:

        def program() -> None:
            link, stop = stage.link, threading.Event()
            link.arm(20.0, stop)
            before_us = stage.clock.time_us()
            link.leave_offboard()
            flown_us.append(stage.clock.time_us() - before_us)
            link.land(30.0)

        stage.run(EpisodeSetup(load_vehicle("quad"), None, 1), program)
    assert end.waited > 3
    # One command, answered after three polls: only this time passes.
    assert TICK_US <= flown_us[0] <= 5 * TICK_US


def test_an_answer_that_never_comes_ends_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("airl_mav.lockstep.stage.LONGEST_ANSWER_US", US_PER_S // 10)
    _, vehicle = late(10_000)
    with (
        LockstepStage(vehicle=vehicle) as stage,
        pytest.raises(FirmwareLostError, match=r"did not answer command \d+"),
    ):
        stage.run(EpisodeSetup(load_vehicle("quad"), None, 1), lambda: None)


# --- PX4's stand-in


def scenario(px4: Path, instance: int, folder: Path, **changes: object) -> Scenario:
    """Return a short flight of it."""
    return Scenario(
        firmware="px4",
        level="lockstep",
        real={"px4_dir": str(px4), "instance": instance},
        seed=SEED,
        episodes=1,
        **{"arena": str(write_arena(folder, 10.0)), **changes},
    )


@pytest.mark.nightly
@pytest.mark.slow
def test_a_flight_with_its_stand_in(tmp_path: Path, px4_instance: int) -> None:
    run = rehearse(
        scenario(write_build(tmp_path / "px4"), px4_instance, tmp_path), out=tmp_path / "run"
    )
    (flown,) = run.episodes
    assert flown.outcome is Outcome.SUCCESS
    assert (flown.invalid, flown.notes, flown.slipped_us) == ((), (), 0)
    assert run.info.setup.firmware.startswith("PX4 1.")
    assert run.sha256 is None  # The host schedules its threads: no two flights are the same bits.
    assert "peer: simulator on TCP port" in (run.path / "autopilot.log").read_text("utf-8")
    names = run.stamps[0].keys()
    assert "sent_us" in names
    assert "accepted_us" not in names
    # A decision takes 1 ms, independent of the host's load.
    t2_us = run.stamps[0]["action_ready_us"] - run.stamps[0]["infer_start_us"]
    np.testing.assert_array_equal(t2_us, 1_000)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_flight_that_loses_it_every_time(tmp_path: Path, px4_instance: int) -> None:
    build = write_build(tmp_path / "px4", "--fault", "die@1")
    resolved = resolve(scenario(build, px4_instance, tmp_path))
    with pytest.raises(LockstepError, match="flight 000, seed 11: lost 3 times; at last PX4"):
        fly(resolved, resolved.fresh_policy(SEED), 0, SEED, log=tmp_path / "log")
    assert (tmp_path / "log").read_text().count("peer: die") == 3


# --- PX4 itself


@pytest.mark.slow
@pytest.mark.skipif(REAL is None, reason="AIRL_PX4_DIR names no PX4")
def test_real_px4_flies_as_the_built_in(tmp_path: Path, px4_instance: int) -> None:
    assert REAL is not None
    arena = {"arena": "static-obstacles"}
    asked = scenario(Path(REAL), px4_instance, tmp_path, **arena)
    reference = Scenario(level="lockstep", seed=SEED, episodes=1, **arena)
    flown, built_in = (
        fly(r, r.fresh_policy(SEED), 0, SEED).record for r in (resolve(asked), resolve(reference))
    )
    assert flown.outcome is built_in.outcome is Outcome.SUCCESS
    assert flown.notes == ()
    assert flown.quality is not None
    assert built_in.quality is not None
    assert flown.quality.flight_time_s == pytest.approx(built_in.quality.flight_time_s, rel=0.3)
    assert flown.quality.distance_m == pytest.approx(built_in.quality.distance_m, rel=0.2)
