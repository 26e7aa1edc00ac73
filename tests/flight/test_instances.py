"""Two instances side by side: ports and system ids of their own, and both fly."""

from __future__ import annotations

from contextlib import ExitStack, closing

import pytest
from pymavlink import mavutil

from airl_mav.core.constants import LOOPBACK
from airl_mav.core.errors import UsageError
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.rehearsal.firmware_process import build_firmware
from airl_mav.scenario.aircraft import Aircraft, Ports, RealFirmware
from airl_mav.scenario.checks import check_ports
from firmware_sim.pacing import Unpaced
from firmware_sim.simulation import EpisodeSetup
from tests.support.ports import free_ports

ARM, TAKEOFF = 400, 22
STEPS_PER_S = 250


def aircraft(instance: int, base: Ports) -> Aircraft:
    return Aircraft(ports=base, real=RealFirmware(instance=instance))


def test_the_number_moves_ports_as_px4s_does() -> None:
    moved = aircraft(3, Ports()).open_ports
    assert (moved.api_port, moved.api_local_port) == (14543, 14583)
    assert (moved.gcs_port, moved.gcs_local_port) == (14550, 18573)
    assert moved.camera_port == 5603
    assert aircraft(3, Ports()).system_id == 4
    any_free = aircraft(3, Ports(api_local_port=0, camera_port=0)).open_ports
    assert (any_free.api_local_port, any_free.camera_port) == (0, 0)
    with pytest.raises(UsageError, match="instance <= 65535"):
        check_ports(aircraft(9, Ports(api_port=65_530)).open_ports, any_camera=True)


def test_two_instances_fly_side_by_side() -> None:
    vehicle = load_vehicle("quad")
    (api, gcs), _ = free_ports(2, 0)
    base = Ports(api_port=api, gcs_port=gcs, api_local_port=0, gcs_local_port=0, camera_port=0)
    with ExitStack() as stack:
        flights = []
        for instance in (1, 2):
            asked = aircraft(instance, base)
            firmware = build_firmware(asked, vehicle, Unpaced(), recording=False)
            stack.enter_context(closing(firmware))
            client = mavutil.mavlink_connection(
                f"udpin:{LOOPBACK}:{api + instance}", dialect="common", source_system=245
            )
            stack.enter_context(closing(client))
            firmware.load(EpisodeSetup(vehicle, None, 1, asked), None, 0)
            flights.append((instance + 1, firmware, client))
        ground = stack.enter_context(closing(mavutil.mavlink_connection(f"udpin:{LOOPBACK}:{gcs}")))
        systems = set()

        def fly(seconds: int) -> None:
            for step in range(seconds * STEPS_PER_S):
                for _, firmware, _ in flights:
                    firmware.step()
                if step % 5 == 0:
                    for client in (ground, *(c for _, _, c in flights)):
                        while (message := client.recv_msg()) is not None:
                            if client is ground and message.get_type() == "HEARTBEAT":
                                systems.add(message.get_srcSystem())

        fly(8)
        for system, _, client in flights:
            # Each is commanded by its own number: the other's is not obeyed.
            client.mav.command_long_send(5 - system, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0)
        fly(1)
        assert not any("COMMAND_ACK" in client.messages for _, _, client in flights)
        for system, _, client in flights:
            client.mav.command_long_send(system, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0)
        fly(2)
        for system, _, client in flights:
            client.mav.command_long_send(system, 1, TAKEOFF, 0, *[float("nan")] * 7)
        fly(6)
        for system, _, client in flights:
            ack, position = client.messages["COMMAND_ACK"], client.messages["LOCAL_POSITION_NED"]
            assert (ack.get_srcSystem(), ack.command, ack.result) == (system, TAKEOFF, 0)
            assert position.z < -1.5
        assert systems == {2, 3}  # both talk to the one ground station
