"""The links of a payload and a gimbal: PX4's streams, at the rates of a real one."""

from __future__ import annotations

import socket
from contextlib import ExitStack, closing

import pytest

from airl_mav.core.constants import LOOPBACK
from airl_mav.core.errors import UsageError
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import bind_device_links, gimbal_link, payload_link
from firmware_sim.mavlink.server import MavlinkServer
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.mavlink_clients import RawClient

MEASURED_PAYLOAD_HZ = {
    "ATTITUDE": 14.32, "GPS_RAW_INT": 10.0, "HIGHRES_IMU": 7.16, "ATTITUDE_QUATERNION": 7.16,
    "GLOBAL_POSITION_INT": 7.16, "LOCAL_POSITION_NED": 4.3, "ODOMETRY": 4.3, "TIMESYNC": 1.43,
    "ALTITUDE": 1.43, "VFR_HUD": 1.43, "HEARTBEAT": 1.0, "MISSION_CURRENT": 1.0,
    "SYS_STATUS": 0.73, "SCALED_PRESSURE": 0.13,
}  # fmt: skip
"""Message rates of a PX4 1.16 SITL over 30 s [Hz]."""

SECONDS = 30


def test_streams_are_those_of_a_real_px4() -> None:
    payload, gimbal = MemoryEndpoint(), MemoryEndpoint()
    autopilot = KinematicAutopilot()
    server = MavlinkServer([payload_link(payload), gimbal_link(gimbal)], autopilot, boot_unix_us=0)
    clients = RawClient(payload), RawClient(gimbal)
    for client in clients:
        client.mav = dialect.MAVLink(None, 245, 190)
    autopilot.yaw = 0.5
    for _ in range(250 * SECONDS):
        autopilot.step()
        server.send(autopilot.time_us)
    per_s = {name: n / SECONDS for name, n in clients[0].count().items()}
    for name, hz in MEASURED_PAYLOAD_HZ.items():
        assert per_s[name] == pytest.approx(hz, rel=0.05, abs=0.05), name
    seen = clients[1].received()
    states = [m for m in seen if m.get_type() == "AUTOPILOT_STATE_FOR_GIMBAL_DEVICE"]
    assert len(states) / SECONDS == pytest.approx(20.0, abs=0.1)
    assert states[-1].q == pytest.approx(autopilot.state().estimate.quaternion.tolist(), abs=1e-6)
    assert states[-1].landed_state == dialect.MAV_LANDED_STATE_ON_GROUND
    assert (states[-1].target_system, states[-1].feed_forward_angular_velocity_z) == (0, 0.0)


def test_a_taken_port_is_left_out_and_told() -> None:
    lines: list[str] = []
    with ExitStack() as stack:
        held = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        held.bind((LOOPBACK, 0))
        instance = held.getsockname()[1] - 14280  # somewhere that is free
        links = bind_device_links(LOOPBACK, LOOPBACK, instance, insecure=False, say=lines.append)
        for link in links:
            stack.enter_context(closing(link.endpoint))
        assert "payload" not in [link.name for link in links]
        assert lines[0] == f"UDP port {14280 + instance} is taken: no payload link"
    with pytest.raises(UsageError, match="insecure"):
        bind_device_links("0.0.0.0", LOOPBACK, 0, insecure=False, say=lines.append)  # noqa: S104
