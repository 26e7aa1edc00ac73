"""A board in HITL over a pseudo-terminal: detection, sensor data and errors."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import TICK_US
from airl_mav.core.errors import UsageError
from firmware_sim.addons.px4_hitl import bridge as hitl
from firmware_sim.addons.px4_hitl.bridge import BoardLink, HitlBridge
from firmware_sim.addons.px4_hitl.line import Router
from firmware_sim.interfaces import (
    ActuatorControls,
    BatterySample,
    FirmwareLostError,
    FirmwareMissingError,
    SensorSample,
)
from firmware_sim.mavlink.codec import Encoder
from tests.support.hitl_peer import HitlPeer

PATIENCE_S = 60.0
STILL = SensorSample(
    0,
    np.array([0.0, 0.0, -9.80665]),
    np.zeros(3),
    20.0,
    BatterySample(16.0, 1.0, 0.0, 1.0),
    np.array([0.21, 0.0, 0.42]),
    955.0,
)
"""A sample on the ground."""


def alive() -> None:
    """There is no process to look after."""


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[HitlPeer]:
    peer = HitlPeer(tmp_path)
    yield peer
    peer.close()


@pytest.fixture
def router() -> Iterator[Router]:
    router = Router({}, WallClock())
    yield router
    router.close()


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A peer on a loaded machine may be silent for longer than a board."""
    monkeypatch.setattr(hitl, "SILENCE_US", int(PATIENCE_S * 1e6))


class Stepper:
    """Steps a bridge with samples of a vehicle at rest."""

    def __init__(self, bridge: HitlBridge) -> None:
        self.bridge = bridge
        self.time_us = 5_000_000

    def step(self) -> ActuatorControls:
        self.time_us += TICK_US
        return self.bridge.step(STILL._replace(time_us=self.time_us))

    def until(self, condition: Callable[[], Any]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, "timed out"
            self.step()

    def forever(self) -> None:
        self.until(lambda: False)


def bridge_to(router: Router, device: str, *, rebooted: bool = False) -> HitlBridge:
    """Make a bridge to a board, which is rebooted when found unless it has just been."""
    link = BoardLink(router, device, 921_600)
    link.went_down = rebooted
    return HitlBridge(link)


@contextmanager
def connected(router: Router, peer: HitlPeer, *, rebooted: bool = True) -> Iterator[Stepper]:
    """Yield a bridge that has had its board's first motor commands."""
    bridge = bridge_to(router, peer.device, rebooted=rebooted)
    try:
        bridge.wait_connected(PATIENCE_S, alive)
        stepper = Stepper(bridge)
        stepper.until(lambda: bridge.time_us)
        yield stepper
    finally:
        bridge.close()


# --- finding the board


def test_a_board_is_rebooted_and_found_again(router: Router, peer: HitlPeer) -> None:
    bridge = bridge_to(router, peer.device)
    bridge.wait_connected(PATIENCE_S, alive)
    assert peer.boots == 2
    assert not bridge.armed
    stepper = Stepper(bridge)
    assert stepper.step().motors == (0.0,) * 4  # no commands yet
    stepper.until(lambda: bridge.time_us)
    bridge.close()
    assert peer.received["HIL_STATE_QUATERNION"] == 0


def test_a_board_behind_a_uart_is_rebooted_though_it_does_not_vanish(
    router: Router, peer: HitlPeer
) -> None:
    peer.vanishes, peer.down_s = False, 3.0
    with connected(router, peer, rebooted=False):
        assert peer.boots == 2


def test_a_board_that_is_armed_is_disarmed_before_it_reboots(
    router: Router, peer: HitlPeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def beat(*_: object) -> None:
        peer.say(Encoder().pack(dialect.MAVLink_heartbeat_message(2, 12, 29 | 32 | 128, 0, 4, 3)))

    peer.board.armed = True
    monkeypatch.setattr(peer.board, "idle", beat)
    monkeypatch.setattr(hitl, "REBOOT_S", 2.0)
    bridge = bridge_to(router, peer.device)
    with pytest.raises(FirmwareLostError, match=r"does not reboot.*MAV_RESULT_DENIED"):
        bridge.wait_connected(PATIENCE_S, alive)
    bridge.close()
    commands = [(m.command, m.param1, m.param2) for m in decoded(peer.raw, "COMMAND_LONG")]
    assert commands[:2] == [(400, 0.0, 21196.0), (246, 1.0, 0.0)]


def decoded(frames: list[bytes], name: str) -> list[Any]:
    mav = dialect.MAVLink(None)
    messages = [mav.decode(bytearray(frame)) for frame in frames]
    return [message for message in messages if message.get_type() == name]


def test_a_board_that_does_not_come_back(router: Router, peer: HitlPeer) -> None:
    peer.down_s = 1e6
    bridge = bridge_to(router, peer.device)
    with pytest.raises(FirmwareLostError, match=r"did not come back: --serial .*no such device"):
        bridge.wait_connected(4.0, alive)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"mute": True}, "no byte was received.*powered.*SYS_USB_AUTO"),
        (
            {"garbled": True},
            "bytes were received, no MAVLink among them: another baud rate than --baud",
        ),
    ],
)
def test_which_step_is_missing(
    router: Router, tmp_path: Path, fault: dict[str, Any], words: str
) -> None:
    peer = HitlPeer(tmp_path)
    vars(peer).update(fault)
    bridge = bridge_to(router, peer.device)
    with pytest.raises(FirmwareMissingError, match=f"--serial .* within 2 s: .*{words}"):
        bridge.wait_connected(2.0, alive)
    bridge.close()
    peer.close()
    assert not peer.received  # nothing is sent to an unidentified device


def test_mavlink_without_an_autopilot(router: Router, peer: HitlPeer) -> None:
    peer.mute = True
    bridge = bridge_to(router, peer.device)
    radio = Encoder(51, 68).pack(dialect.MAVLink_radio_status_message(1, 1, 1, 1, 1, 1, 1))

    def talk() -> None:
        peer.mute = False
        peer.say(radio)
        peer.mute = True

    with pytest.raises(FirmwareMissingError, match="no heartbeat of an autopilot"):
        bridge.wait_connected(1.0, talk)
    bridge.close()


@pytest.mark.parametrize(
    ("beat", "words"),
    [
        ((2, 12, 29, 0, 3, 3), "not in HIL mode.*set SYS_HITL = 1.*HIL Quadcopter X"),
        ((2, 3, 81 | 32, 0, 3, 3), "not a PX4"),
    ],
)
def test_a_board_that_is_set_up_otherwise(
    router: Router, peer: HitlPeer, beat: tuple[int, ...], words: str
) -> None:
    peer.mute = True
    frame = Encoder().pack(dialect.MAVLink_heartbeat_message(*beat))
    bridge = bridge_to(router, peer.device)

    def talk() -> None:
        peer.mute = False
        peer.say(frame)
        peer.mute = True

    with pytest.raises(FirmwareMissingError, match=words):
        bridge.wait_connected(PATIENCE_S, talk)
    bridge.close()
    assert peer.received["HIL_SENSOR"] == 0


def test_a_device_that_is_not_there_is_told_at_once(router: Router, tmp_path: Path) -> None:
    bridge = bridge_to(router, str(tmp_path / "ttyACM0"))
    with pytest.raises(UsageError, match="no such device"):
        bridge.wait_connected(1e6, alive)


def test_giving_up_while_it_waits(router: Router, peer: HitlPeer) -> None:
    class StopError(Exception): ...

    def stop() -> None:
        raise StopError

    peer.mute = True
    bridge = bridge_to(router, peer.device)
    with pytest.raises(StopError):
        bridge.wait_connected(1e6, stop)
    bridge.close()


# --- in flight


def test_motors_stand_still_while_disarmed(router: Router, peer: HitlPeer) -> None:
    with connected(router, peer) as stepper:
        # The board's outputs are not zero then.
        assert stepper.step() == ActuatorControls(stepper.time_us, (0.0,) * 4, armed=False)


def test_the_boards_own_clock_is_its_time(router: Router, peer: HitlPeer) -> None:
    with connected(router, peer) as stepper:
        first = stepper.bridge.time_us
        stepper.until(lambda: stepper.bridge.time_us > first + 100_000)
        assert stepper.bridge.time_us <= peer.board.time_us
        # Sent times advance evenly from a small number, independent of simulated time.
        assert np.unique(np.diff(peer.sensor_times)).tolist() == [TICK_US]
        assert peer.sensor_times[0] == 1_000_000


def test_ticks_keep_to_250_a_second_however_often_they_are_asked_for(
    router: Router, peer: HitlPeer
) -> None:
    with connected(router, peer) as stepper:
        began = time.monotonic()
        for _ in range(250):
            stepper.step()
        assert time.monotonic() - began > 0.95  # 1 % faster at most, and the tick before


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (lambda peer: setattr(peer, "mute", True), "board silent: no HIL_ACTUATOR_CONTROLS"),
        (lambda peer: setattr(peer, "controls", False), "board silent"),
        (lambda peer: setattr(peer, "garbled", True), "board silent"),
        (HitlPeer.unplug, "is gone"),
        (HitlPeer.leave_hil, "left HIL mode"),
        (lambda peer: setattr(peer, "flags", 1), "flags is 1"),
    ],
    ids=["mute", "no controls", "garbled", "unplugged", "no HIL", "flags"],
)
def test_a_flight_that_is_over(
    router: Router,
    peer: HitlPeer,
    monkeypatch: pytest.MonkeyPatch,
    fault: Callable[[HitlPeer], None],
    words: str,
) -> None:
    if "silent" in words:
        monkeypatch.setattr(hitl, "SILENCE_US", 3_000_000)
    with connected(router, peer) as stepper:
        fault(peer)
        with pytest.raises(FirmwareLostError, match=words):
            stepper.forever()
        with pytest.raises(FirmwareLostError, match=words):
            stepper.step()


def test_a_board_that_restarts_in_flight(router: Router, peer: HitlPeer) -> None:
    with connected(router, peer) as stepper:
        peer.board.time_us += 60_000_000
        first = stepper.bridge.time_us
        stepper.until(lambda: stepper.bridge.time_us > first + 50_000_000)
        peer.reset()
        with pytest.raises(FirmwareLostError, match="restarted: its clock went back"):
            stepper.forever()


def test_a_board_that_somebody_reboots(router: Router, peer: HitlPeer) -> None:
    with connected(router, peer) as stepper:
        reboot = dialect.MAVLink_command_long_message(1, 1, 246, 0, 1, 0, 0, 0, 0, 0, 0)
        assert router.pass_to_board(Encoder(255, 190).pack(reboot))
        with pytest.raises(FirmwareLostError, match=r"told to reboot|is gone"):
            stepper.forever()


@pytest.mark.parametrize(("flags", "words"), [(1, "lockstep build"), (0b0111, "HIL_ACT_FUNC1")])
def test_outputs_that_are_no_quadrotors(
    router: Router, peer: HitlPeer, flags: int, words: str
) -> None:
    peer.flags = flags
    with pytest.raises(FirmwareMissingError, match=words), connected(router, peer) as stepper:
        stepper.forever()


def test_newer_boards_mark_their_motors(router: Router, peer: HitlPeer) -> None:
    peer.flags = 0b1111
    with connected(router, peer) as stepper:
        stepper.step()


def test_a_board_that_never_sends_motor_commands(
    router: Router, peer: HitlPeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer.controls = False
    monkeypatch.setattr(hitl, "FIRST_CONTROLS_US", 500_000)
    bridge = bridge_to(router, peer.device, rebooted=True)
    bridge.wait_connected(PATIENCE_S, alive)
    with pytest.raises(FirmwareMissingError, match=r"sends no HIL_ACTUATOR_CONTROLS.*pwm_out_sim"):
        Stepper(bridge).forever()
    bridge.close()


def test_noise_between_frames_does_no_harm(router: Router, peer: HitlPeer) -> None:
    with connected(router, peer) as stepper:
        peer.noise = b"\xfd\xfe\x00\xff noise \xfd\x10"
        first = stepper.bridge.time_us
        stepper.until(lambda: stepper.bridge.time_us > first + 1_500_000)


def test_a_standstill_of_ours_is_no_silence_of_the_boards(
    router: Router, peer: HitlPeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hitl, "SILENCE_US", 1_500_000)
    with connected(router, peer) as stepper:
        time.sleep(0.5)
        router.pump()  # data from before the pause
        time.sleep(2.0)  # a board without sensors says nothing more
        for _ in range(250):
            stepper.step()


def test_a_closed_bridge_can_be_closed_and_not_stepped(router: Router, peer: HitlPeer) -> None:
    with connected(router, peer) as stepper:
        stepper.bridge.close()
        stepper.bridge.close()
        with pytest.raises(FirmwareLostError, match="not connected"):
            stepper.step()
