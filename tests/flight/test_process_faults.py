"""Process faults that stop or kill the companion or the firmware: real processes and signals."""

from __future__ import annotations

from pathlib import Path

import pytest

from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Outcome
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.rehearsal.run_folder import FlownEpisode, load
from tests.support.lockstep_kit import SEED, demo_scenario
from tests.support.ports import choose_ports
from tests.support.processes import SITL_WITHOUT_REPORT, running, write_arena

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("rehearsal"), pytest.mark.timeout(300)]

NIGHTLY = pytest.mark.nightly
GOES_ON_US = 200_000
"""Maximum time from a signal to its effect, and back [simulated µs]."""


def flown(folder: Path, fault: str) -> EpisodeRecord:
    """Fly once, far from any goal."""
    words = [
        *SITL_WITHOUT_REPORT,
        *("--arena", str(write_arena(folder, 60.0)), "--speed", "3", "--episodes", "1"),
        *("--out", str(folder / "run"), "--fault", fault, *choose_ports().options()),
    ]
    with running(words, folder) as process:
        process.find_children("firmware", "companion")
        assert process.wait(250.0) == 0, process.text()
        process.no_child_left()
    (record,) = load(folder / "run").episodes
    assert not [note for note in record.notes if "flown again" in note]
    assert [each.fault for each in record.faults] == [fault]
    return record


@pytest.mark.parametrize("kind", [pytest.param("stopped", marks=NIGHTLY), "killed"])
def test_without_its_companion_the_vehicle_comes_down(tmp_path: Path, kind: str) -> None:
    record = flown(tmp_path, f"companion {kind} at offboard+1s")
    told, failsafe, *_ = record.notes
    assert told.startswith(f"companion {kind} at ")
    assert failsafe.endswith("Failsafe activated")
    assert record.outcome in (Outcome.ABORTED, Outcome.COLLISION)
    if record.outcome is Outcome.ABORTED:
        assert record.reason == f"companion {kind}"


@NIGHTLY
@pytest.mark.parametrize("kind", ["stopped", "killed"])
def test_without_its_firmware_a_flight_ends_by_name(tmp_path: Path, kind: str) -> None:
    record = flown(tmp_path, f"firmware {kind} at offboard+1s")
    assert (record.outcome, record.reason) == (Outcome.ABORTED, f"firmware {kind}")
    (run,) = load(tmp_path / "run").trajectories.values()
    assert run.time_us[-1] >= record.faults[0].from_us - GOES_ON_US


@NIGHTLY
def test_a_firmware_that_stood_for_a_second_flies_on(tmp_path: Path) -> None:
    record = flown(tmp_path, "firmware stopped at offboard+1s for 1s")
    assert record.outcome is Outcome.SUCCESS
    assert record.slipped_us > 1_000_000 - GOES_ON_US


# --- in lockstep


def in_lockstep(fault: str, **more: float) -> FlownEpisode:
    resolved = demo_scenario(faults=(fault,), time_limit_s=30.0, **more)
    return fly(resolved, resolved.fresh_policy(SEED), 0, SEED)


def test_a_suspended_companion_decides_nothing() -> None:
    episode = in_lockstep("companion stopped at offboard+200ms for 700ms", goal_radius_m=1.5)
    record, (acted,) = episode.record, episode.record.faults
    assert acted.to_us - acted.from_us == 700_000
    assert record.outcome is Outcome.SUCCESS
    sent = episode.latency["sent_us"]
    assert not ((sent > acted.from_us) & (sent < acted.to_us)).any()
    assert (sent > acted.to_us).any()


def test_a_companion_killed_in_lockstep_leaves_the_vehicle_to_its_failsafe() -> None:
    # High enough to stand before it is on the ground.
    episode = in_lockstep("companion killed at offboard+200ms", goal_radius_m=0.5, altitude_m=6.0)
    record = episode.record
    assert (record.outcome, record.reason) == (Outcome.ABORTED, "companion killed")
    assert abs(episode.trajectory.position[-1, 2]) < 0.2
    assert not len(episode.latency["sent_us"])
