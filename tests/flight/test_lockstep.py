"""Lockstep with the real MAVSDK: bit-identical flights under any load of the machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as dialect
from pyulog import ULog

from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.flight.judge import Outcome
from airl_mav.latency.injection import FixedSampler
from airl_mav.lockstep import stage as stage_module
from airl_mav.lockstep.conductor import REPEAT_US, Inbound
from airl_mav.lockstep.lockstep_flight import fly
from airl_mav.lockstep.stage import LockstepStage, ThreadPartner, newest
from airl_mav.lockstep.turns import LANES, Handle, LockstepError, Turn
from airl_mav.policy.actions import Action
from airl_mav.policy.observation import Observation
from airl_mav.profiles.vehicle import WindSettings, load_vehicle
from airl_mav.rehearsal.run_folder import FlownEpisode
from airl_mav.scenario.checks import TRANSPORT_US
from airl_mav.scenario.model import LimitSettings, PilotSettings, WatchdogSettings
from airl_mav.scenario.resolve import ResolvedScenario
from companion.link_interface import BodyVelocity
from companion.pilot import Mission, fly_mission
from companion.watchdog import Poll
from firmware_sim.autopilot.failsafes.framework import LOOK_US
from firmware_sim.mavlink.codec import Encoder
from firmware_sim.simulation import EpisodeSetup
from tests.support import lockstep_kit
from tests.support.full_disk import largest_file
from tests.support.lockstep_kit import BEGINS, SEED, demo_scenario

LONG_MS = 200.0
RERUNS, STOPPED = 2, 2
LOGS = "flight.tlog", "flight.ulg"


@pytest.fixture(scope="module")
def scenario() -> ResolvedScenario:
    return demo_scenario()


def flown(scenario: ResolvedScenario, seed: int = SEED) -> FlownEpisode:
    return fly(scenario, scenario.fresh_policy(seed), 0, seed)


@pytest.fixture(scope="module")
def reference(scenario: ResolvedScenario) -> FlownEpisode:
    return flown(scenario)


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """Keep more processes busy than there are cores."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


# --- the same flight


def test_the_flight_is_a_flight(reference: FlownEpisode) -> None:
    record = reference.record
    assert record.outcome is Outcome.SUCCESS
    assert record.notes == ()
    assert record.sha256 is not None
    assert set(record.sha256) == {"flight", *LANES}
    assert len(set(record.sha256.values())) == len(LANES) + 1
    assert np.all(reference.latency["accepted_us"] > 0), "every decision reached the autopilot"


def test_a_vehicle_without_gps_is_told_where_it_is_and_flies() -> None:
    """The companion sends the position, as on the aircraft: Hold requires a global position."""
    flight = flown(demo_scenario(vehicle="quad-vio"))
    assert flight.record.outcome is Outcome.SUCCESS
    assert flight.record.notes == ()


def test_a_take_off_takes_about_as_long_as_movers_are_told(reference: FlownEpisode) -> None:
    record = reference.record
    assert record.navigation_us is not None
    took_s = (record.navigation_us - record.started_us) / US_PER_S
    # At 2.5 m/s half a second is little more than the width of an obstacle.
    assert record.tours_s == pytest.approx(took_s, abs=0.5)


def test_a_flight_on_a_full_disk_goes_on_without_its_logs(
    scenario: ResolvedScenario, reference: FlownEpisode, tmp_path: Path
) -> None:
    """The flight is identical; messages logged before the failure are readable."""
    tlog = tmp_path / "flight.tlog"
    with largest_file(65_536):
        episode = fly(scenario, scenario.fresh_policy(SEED), 0, SEED, tlog=tlog)
    assert episode.record.sha256 == reference.record.sha256
    lost = [note.partition(";")[0] for note in episode.record.notes]
    assert sorted(lost) == [f"{tmp_path / name}: File too large" for name in LOGS]
    frames = mavutil.mavlogfile(str(tlog))
    while (message := frames.recv_match()) is not None:
        assert message.get_type() != "BAD_DATA"
    frames.close()
    assert ULog(str(tmp_path / "flight.ulg")).data_list


@pytest.mark.nightly
def test_reruns_under_load_are_the_same(
    scenario: ResolvedScenario, reference: FlownEpisode
) -> None:
    """Some of them; `scripts/lockstep_reruns.py` does a hundred."""
    with busy(2):
        reruns = [flown(scenario) for _ in range(RERUNS)]
    assert [rerun.record for rerun in reruns] == [reference.record] * RERUNS
    for rerun in reruns:
        for name, values in reference.trajectory.arrays().items():
            np.testing.assert_array_equal(rerun.trajectory.arrays()[name], values)
        assert rerun.latency.keys() == reference.latency.keys()
        for name, values in reference.latency.items():
            np.testing.assert_array_equal(rerun.latency[name], values)


def test_waits_take_few_turns_and_are_the_flight_that_polls(
    scenario: ResolvedScenario, reference: FlownEpisode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With all telemetry fed, and a turn for every look at it."""
    turns: list[int] = []

    class Counting(ThreadPartner):
        def turn(self, now_us: int, handle: Handle) -> Turn:
            turns[-1] += 1
            return super().turn(now_us, handle)

    class Polling(Counting):
        def send(self, frames: Sequence[bytes]) -> None:
            self._fed = True
            self._feed(b"".join(frames))

        def sleep(
            self,
            wake_us: int,
            interrupt: threading.Event | None = None,
            poll: Poll | None = None,
        ) -> None:
            super().sleep(wake_us, interrupt)

    for partner in (Counting, Polling):
        turns.append(0)
        monkeypatch.setattr(stage_module, "ThreadPartner", partner)
        assert flown(scenario).record == reference.record
    few, many = turns
    assert 3 * few < many


@pytest.mark.nightly
def test_without_the_barrier_reruns_differ(
    scenario: ResolvedScenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control experiment: without the barrier, reruns differ."""

    class Hasty(ThreadPartner):
        def _settle(self, handle: Handle) -> None:
            del handle

    monkeypatch.setattr(stage_module, "ThreadPartner", Hasty)
    flights: set[str] = set()
    with busy(2):
        for _ in range(10):
            record = flown(scenario).record
            assert record.sha256 is not None
            flights.add(record.sha256["flight"])
            if len(flights) > 1:
                break
    assert len(flights) > 1


def test_other_flights_are_others(scenario: ResolvedScenario, reference: FlownEpisode) -> None:
    assert reference.record.sha256 is not None
    for other in (
        flown(scenario, SEED + 1),
        flown(demo_scenario(latency="1.001ms")),
        flown(demo_scenario(wind=WindSettings(north_m_s=0.1))),
    ):
        assert other.record.sha256 is not None
        assert other.record.sha256["trajectory"] != reference.record.sha256["trajectory"]


@pytest.mark.nightly  # Others flew before: test_evaluate_lockstep.py.
def test_earlier_flights_leave_no_trace(
    scenario: ResolvedScenario, reference: FlownEpisode
) -> None:
    flown(scenario, 3)
    assert flown(scenario).record == reference.record


@pytest.mark.nightly
def test_a_process_that_is_stopped_flies_the_same(reference: FlownEpisode) -> None:
    """SIGSTOP: MAVSDK's timers expire during the stop, by the wall clock."""
    moments = np.random.default_rng(5)
    command = [sys.executable, lockstep_kit.__file__, f"{STOPPED}"]
    environment = {**os.environ, "PYTHONPATH": str(Path.cwd())}
    fingerprints = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as child:
        assert child.stdout is not None
        try:
            for line in child.stdout:
                if line.strip() != BEGINS:
                    fingerprints.append(line.strip())
                    continue
                time.sleep(moments.uniform(0.0, 0.3))
                child.send_signal(signal.SIGSTOP)
                # Longer than the 3 s after which MAVSDK misses heartbeats.
                time.sleep(4.0)
                child.send_signal(signal.SIGCONT)
        finally:
            child.kill()
    assert reference.record.sha256 is not None
    assert fingerprints == [reference.record.sha256["flight"]] * STOPPED


@pytest.mark.nightly  # Nor the tick of a failsafe: below.
def test_pace_changes_nothing(reference: FlownEpisode) -> None:
    assert flown(demo_scenario(speed=25.0)).record == reference.record


def test_filterpy_flies_the_same_to_rounding(reference: FlownEpisode) -> None:
    """A whole flight on the estimator's reference: rounding stays rounding."""
    other = flown(demo_scenario(estimator="filterpy"))
    assert other.record.outcome is Outcome.SUCCESS
    ours, theirs = reference.trajectory, other.trajectory
    assert len(ours) == len(theirs)
    np.testing.assert_allclose(ours.position, theirs.position, atol=1e-6)
    assert reference.record.sha256 != other.record.sha256, "another filter did fly"


# --- latency


def test_latency_acts_in_simulated_time() -> None:
    """A decision at t takes effect at t + t2; the old setpoint flies on, repeated at 20 Hz."""
    stamps = flown(demo_scenario(latency=f"{LONG_MS:g}ms")).latency
    assert len(stamps["sent_us"]) >= 3
    took = stamps["action_ready_us"] - stamps["infer_start_us"]
    assert np.all(took == LONG_MS * 1_000)
    np.testing.assert_array_equal(stamps["sent_us"], stamps["action_ready_us"])
    np.testing.assert_array_equal(stamps["accepted_us"], stamps["sent_us"])
    wait = stamps["motor_us"] - stamps["accepted_us"]
    # The position loop runs at every second tick; attitude and rates hand over a tick each.
    assert np.all((wait >= 2 * TICK_US) & (wait < 4 * TICK_US))
    t1 = stamps["decoded_us"] - stamps["capture_us"]
    assert np.all((t1 >= TRANSPORT_US) & (t1 <= TRANSPORT_US + 34_000 + TICK_US))


# --- failsafes: the same tick at every speed


def still(_: Observation) -> Action:
    return Action(0.0, 0.0, 0.0)


class Still:
    def act(self, observation: Observation) -> Action:
        return still(observation)


def airborne(stage: LockstepStage) -> None:
    stop = stage.abandon
    stage.link.arm(20.0, stop)
    stage.link.takeoff(2.5, 30.0, stop)
    stage.link.enter_offboard()


def companion_dies(stage: LockstepStage) -> None:
    airborne(stage)
    stage.link.send_setpoint(BodyVelocity(1.0, 0.0, 0.0, 0.3))


def policy_hangs(stage: LockstepStage) -> None:
    watchdog = WatchdogSettings(decision_timeout_s=1.0, leave_after_s=1.0)
    mission = Mission(
        (500.0, 0.0),
        Still(),
        PilotSettings(),
        watchdog,
        LimitSettings(),
        latency=FixedSampler(10 * US_PER_S),
    )
    stop, clock = stage.abandon, stage.clock
    result = fly_mission(
        stage.link, stage.camera, mission, clock, stop, stop, lambda _: None, clock
    )
    # Without an arena there is nothing to see: it hangs in waiting for a frame.
    assert result.reason == "camera silent"
    assert len(result.notes) == 2


def fly_on(stage: LockstepStage, seconds: float) -> None:
    """Fly on for a while when the companion's program has ended."""
    until_us = stage.conductor.clock.time_us() + int(seconds * US_PER_S)
    while stage.conductor.clock.time_us() < until_us:
        stage.firmware.step()


def nobody_takes_off(stage: LockstepStage) -> None:
    stage.link.arm(20.0, stage.abandon)


def battery_runs_low(stage: LockstepStage) -> None:
    airborne(stage)
    for _ in range(120):
        stage.link.send_setpoint(BodyVelocity(0.5, 0.0, 0.0, 0.0))
        stage.clock.sleep_until(stage.clock.time_us() + US_PER_S // 10)


FAILSAFES = [
    pytest.param(companion_dies, "Failsafe activated", None, marks=pytest.mark.nightly),
    (policy_hangs, "Landing", None),
    (nobody_takes_off, "auto preflight", None),
    pytest.param(battery_runs_low, "battery", 40.0, marks=pytest.mark.nightly),
]


@pytest.mark.parametrize(
    ("program", "word", "capacity_mah"), FAILSAFES, ids=lambda value: getattr(value, "__name__", "")
)
def test_failsafes_come_at_the_same_tick_at_every_speed(
    scenario: ResolvedScenario,
    program: Callable[[LockstepStage], None],
    word: str,
    capacity_mah: float | None,
) -> None:
    vehicle = scenario.vehicle
    if capacity_mah is not None:
        battery = vehicle.battery.model_copy(update={"capacity_mah": capacity_mah})
        vehicle = vehicle.model_copy(update={"battery": battery})
    setup = EpisodeSetup(vehicle, None, 1)

    def events(speed: float | None) -> list[tuple[int, str]]:
        found: list[tuple[int, str]] = []
        with LockstepStage(speed=speed) as stage:
            firmware, now_us = stage.firmware, stage.conductor.clock.time_us
            firmware.on_message = lambda message: found.append((now_us(), message.text))
            stage.run(setup, lambda: program(stage))
            fly_on(stage, 12.0)
        return found

    by_speed = {speed: events(speed) for speed in (None, 30.0)}
    assert any(word.lower() in text.lower() for _, text in by_speed[None]), by_speed[None]
    assert by_speed[30.0] == by_speed[None]


def test_offboard_loss_comes_one_second_after_the_last_setpoint() -> None:
    """COM_OF_LOSS_T; MAVSDK's repeated setpoints end with its process."""
    told: list[int] = []
    setup = EpisodeSetup(load_vehicle("quad"), None, 1)
    with LockstepStage() as stage:
        now_us = stage.conductor.clock.time_us
        stage.firmware.on_message = lambda message: (
            told.append(now_us()) if "Failsafe" in message.text else None
        )
        simulation = stage.run(setup, lambda: companion_dies(stage))
        fly_on(stage, 2.0)
        assert simulation.recorder is not None
        last_us = int(simulation.recorder.setpoints.arrays()["accepted_us"][-1])
    assert len(told) == 1
    assert US_PER_S < told[0] - last_us <= US_PER_S + LOOK_US + 2 * TICK_US


# --- what goes wrong


def test_a_broken_companion_is_told() -> None:
    def broken() -> None:
        raise ZeroDivisionError("nothing to share")

    setup = EpisodeSetup(load_vehicle("quad"), None, 1)
    with (
        LockstepStage() as stage,
        pytest.raises(LockstepError, match="ZeroDivisionError: nothing to"),
    ):
        stage.run(setup, broken)


def test_bad_input_stays_bad_input() -> None:
    def refused() -> None:
        raise UsageError("--policy p: camera is not the one")

    setup = EpisodeSetup(load_vehicle("quad"), None, 1)
    with LockstepStage() as stage, pytest.raises(UsageError, match="camera is not the one"):
        stage.run(setup, refused)


def test_a_hanging_companion_is_told() -> None:
    setup = EpisodeSetup(load_vehicle("quad"), None, 1)
    told = "the companion hangs: its turn did not end in 1 s"
    with LockstepStage(patience_s=1.0) as stage, pytest.raises(LockstepError, match=told):
        stage.run(setup, lambda: time.sleep(3.0))


# --- what reaches the flight controller


class Sdk:
    """Frames as MAVSDK sends them."""

    def __init__(self) -> None:
        self._mav = dialect.MAVLink(None, 245, 191)

    def pack(self, message: dialect.MAVLink_message) -> bytes:
        frame: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame

    def setpoint(self, forward: float, boot_ms: int) -> bytes:
        zeros = (0.0,) * 3
        return self.pack(
            dialect.MAVLink_set_position_target_local_ned_message(
                *(boot_ms, 1, 1, 8, 1479, *zeros, forward, 0.0, 0.0, *zeros, 0.0, 0.0)
            )
        )

    def command(self, number: int, *params: float) -> bytes:
        filled = [*params, *[float("nan")] * (7 - len(params))]
        return self.pack(dialect.MAVLink_command_long_message(1, 1, number, 0, *filled))


def decoded(frame: bytes) -> dialect.MAVLink_message:
    return dialect.MAVLink(None).decode(bytearray(frame))


def test_of_states_the_newest_is_fed_and_everything_else_in_its_place() -> None:
    vehicle, other = Encoder(), Encoder(component_id=158)
    zeros = (0.0,) * 3

    def attitude(by: Encoder, boot_ms: int) -> bytes:
        return by.pack(dialect.MAVLink_attitude_message(boot_ms, *zeros, *zeros))

    def text(words: bytes) -> bytes:
        return vehicle.pack(dialect.MAVLink_statustext_message(6, words))

    ping = vehicle.pack(dialect.MAVLink_ping_message(0, 1, 0, 0))
    frames = [
        *(attitude(vehicle, 1), text(b"one"), attitude(other, 2), ping),
        *(attitude(vehicle, 3), text(b"one"), ping),
    ]
    assert newest(frames) == frames[1:]


def test_repetitions_by_the_wall_clock_are_dropped() -> None:
    sdk, inbound = Sdk(), Inbound()
    (first,) = inbound.take(sdk.setpoint(1.0, 17), 8_000).deliver
    assert decoded(first).vx == 1.0
    assert decoded(first).time_boot_ms == 8, "stamped in simulated time"
    assert inbound.take(sdk.setpoint(1.0, 67), 8_000).deliver == ()
    assert inbound.take(sdk.setpoint(1.0, 117), 12_000).deliver == ()
    (other,) = inbound.take(sdk.setpoint(2.0, 118), 12_000).deliver
    assert decoded(other).vx == 2.0


def test_repetitions_come_in_simulated_time() -> None:
    sdk, inbound = Sdk(), Inbound()
    assert inbound.next_repeat_us is None
    inbound.take(sdk.setpoint(1.0, 17), 8_000)
    assert inbound.next_repeat_us == 8_000 + REPEAT_US
    again = decoded(inbound.repeat(58_000))
    assert (again.vx, again.time_boot_ms) == (1.0, 58)
    assert inbound.next_repeat_us == 58_000 + REPEAT_US
    inbound.end()
    assert inbound.next_repeat_us is None


def test_the_same_setpoint_on_purpose_counts() -> None:
    sdk, inbound = Sdk(), Inbound()
    inbound.take(sdk.setpoint(1.0, 17), 8_000)
    assert inbound.renewed(1, 8_000) is None, "the one that was delivered"
    assert inbound.take(sdk.setpoint(1.0, 50), 30_000).deliver == ()
    again = inbound.renewed(2, 30_000)
    assert again is not None
    assert decoded(again).time_boot_ms == 30
    assert inbound.next_repeat_us == 30_000 + REPEAT_US
    assert inbound.renewed(2, 34_000) is None


@pytest.mark.parametrize("number", [20, 21, 22, 176])
def test_leaving_offboard_ends_the_repetitions(number: int) -> None:
    sdk, inbound = Sdk(), Inbound()
    inbound.take(sdk.setpoint(1.0, 17), 8_000)
    assert len(inbound.take(sdk.command(number, 1.0, 4.0, 3.0), 12_000).deliver) == 1
    assert inbound.next_repeat_us is None
    assert inbound.take(sdk.setpoint(1.0, 67), 12_000).deliver == (), "one still under way"
    assert inbound.next_repeat_us is None


def test_offboard_again_with_the_same_setpoint() -> None:
    sdk, inbound = Sdk(), Inbound()
    inbound.take(sdk.setpoint(0.0, 17), 8_000)
    inbound.take(sdk.command(176, 1.0, 4.0, 3.0), 12_000)
    inbound.take(sdk.setpoint(0.0, 99), 16_000)
    fresh, mode = inbound.take(sdk.command(176, 1.0, 6.0, 0.0), 16_000).deliver
    assert decoded(fresh).get_type() == "SET_POSITION_TARGET_LOCAL_NED"
    assert decoded(mode).command == 176
    assert inbound.next_repeat_us == 16_000 + REPEAT_US


def test_what_mavsdk_asks_by_the_wall_clock_is_answered_here() -> None:
    sdk, inbound = Sdk(), Inbound()
    for number, wanted, result in (
        (512, 242.0, dialect.MAV_RESULT_DENIED),
        (511, 245.0, dialect.MAV_RESULT_ACCEPTED),
    ):
        passed = inbound.take(sdk.command(number, wanted, 1e6), 8_000)
        assert passed.deliver == ()
        assert passed.answer is not None
        answer = decoded(passed.answer)
        assert (answer.get_type(), answer.command, answer.result) == ("COMMAND_ACK", number, result)
        assert (answer.target_system, answer.target_component) == (245, 191)


def test_heartbeats_and_pings_stay_outside() -> None:
    sdk, inbound = Sdk(), Inbound()
    for message in (
        dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 0, 3),
        dialect.MAVLink_ping_message(0, 7, 0, 0),
        dialect.MAVLink_ping_message(0, 7, 1, 1),
        dialect.MAVLink_timesync_message(0, 1),
    ):
        passed = inbound.take(sdk.pack(message), 8_000)
        assert (passed.deliver, passed.answer) == ((), None)


def test_requests_do_not_shift_the_numbers_of_what_counts() -> None:
    """MAVSDK sends them in any order: the frames of the flight must be the same."""
    sdk, quiet, asked = Sdk(), Inbound(), Inbound()
    arm = sdk.command(400, 1.0)
    passed = asked.take(sdk.command(512, 148.0), 4_000)
    assert len(passed.deliver) == 1
    assert not passed.of_the_flight
    assert asked.take(arm, 8_000) == quiet.take(arm, 8_000)
