"""The links of a payload and a gimbal: PX4's streams, at the rates of a real one."""

from __future__ import annotations

import socket

import pytest

from airl_mav.core.constants import LOOPBACK
from airl_mav.core.errors import UsageError
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import GIMBAL_PORTS, bind_gimbal_link, gimbal_link
from firmware_sim.mavlink.server import MavlinkServer
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import RawClient

SECONDS = 30


def test_streams_are_those_of_a_real_px4() -> None:
    gimbal, autopilot = MemoryEndpoint(), KinematicAutopilot()
    server = MavlinkServer([gimbal_link(gimbal)], autopilot, boot_unix_us=0)
    client = RawClient(gimbal)
    client.mav = dialect.MAVLink(None, 245, 190)
    autopilot.yaw = 0.5
    for _ in range(250 * SECONDS):
        autopilot.step()
        server.send(autopilot.time_us)
    seen = client.received()
    states = [m for m in seen if m.get_type() == "AUTOPILOT_STATE_FOR_GIMBAL_DEVICE"]
    assert len(states) / SECONDS == pytest.approx(20.0, abs=0.1)
    assert states[-1].q == pytest.approx(autopilot.state().estimate.quaternion.tolist(), abs=1e-6)
    assert states[-1].landed_state == dialect.MAV_LANDED_STATE_ON_GROUND
    assert (states[-1].target_system, states[-1].feed_forward_angular_velocity_z) == (0, 0.0)


def test_a_taken_port_is_left_out_and_told() -> None:
    lines: list[str] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind((LOOPBACK, 0))
        port = held.getsockname()[1]
        instance = port - GIMBAL_PORTS[0]
        assert not bind_gimbal_link(LOOPBACK, LOOPBACK, instance, insecure=False, say=lines.append)
    assert lines == [f"UDP port {port} is taken: no gimbal link"]
    with pytest.raises(UsageError, match="insecure"):
        bind_gimbal_link("0.0.0.0", LOOPBACK, 0, insecure=False, say=lines.append)  # noqa: S104
