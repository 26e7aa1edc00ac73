"""Twenty clients at 50 Hz with parameter downloads: all requests are answered."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as dialect

from airl_mav.core.clock import SimClock
from airl_mav.core.constants import TICK_US, US_PER_S
from firmware_sim.addons.flight_log.flight_log import UlogFlightLog
from firmware_sim.addons.ground_station_services.logs import PACKETS_PER_TICK
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import gcs_link, onboard_link
from firmware_sim.mavlink.server import LEAST_PIECES_PER_TICK, PIECES_PER_TICK, MavlinkServer
from tests.support.kinematic_autopilot import KinematicAutopilot
from tests.support.memory_hub import MemoryHub

CLIENTS = 20
SECONDS = 3
EVERY = 5
"""Ticks between two commands of a client: 50 Hz."""

ACK, PARAM, ATTITUDE, LOG_DATA = (
    number.to_bytes(3, "little")
    for number in (
        dialect.MAVLINK_MSG_ID_COMMAND_ACK,
        dialect.MAVLINK_MSG_ID_PARAM_VALUE,
        dialect.MAVLINK_MSG_ID_ATTITUDE,
        dialect.MAVLINK_MSG_ID_LOG_DATA,
    )
)


def test_twenty_clients_at_50_hz_with_parameter_downloads() -> None:
    hub, autopilot = MemoryHub(), KinematicAutopilot()
    server = MavlinkServer(
        [onboard_link(MemoryEndpoint()), gcs_link(hub)], autopilot, boot_unix_us=0
    )
    # Each client is a separate system, so that an answer names its requester.
    clients = [hub.client(port, (100 + port, 190)) for port in range(CLIENTS)]
    ticks = SECONDS * US_PER_S // TICK_US
    sent = 0
    for tick in range(ticks):
        for n, client in enumerate(clients):
            if tick % EVERY == n % EVERY:
                client.command(512, dialect.MAVLINK_MSG_ID_MESSAGE_INTERVAL, 30)
                sent += 1
            if tick == 10 + n:
                client.send(dialect.MAVLink_param_request_list_message(1, 1))
        server.receive(autopilot.time_us)
        autopilot.step()
        server.send(autopilot.time_us)
    size = len(autopilot.parameters)
    answered = 0
    for n, client in enumerate(clients):
        # By the bytes: pymavlink would take longer to read them all than the vehicle to send.
        frames = [frame for frame in client.endpoint.take() if frame[5:7] == b"\1\1"]
        count = Counter(frame[7:10] for frame in frames)
        assert count[PARAM] == size + 1  # with the hash
        assert count[ATTITUDE] >= 50 * SECONDS - 5
        assert all((b[4] - a[4]) % 256 == 1 for a, b in pairwise(frames))  # nothing is lost
        for frame in frames:
            if frame[7:10] == ACK:
                (ack,) = client.mav.parse_buffer(frame)
                assert (ack.target_system, ack.result) == (100 + n, 0)
                answered += 1
    counters = server.counters()["gcs"]
    assert answered == sent == CLIENTS * ticks // EVERY
    assert (counters.dropped, counters.malformed, counters.send_errors) == (0, 0, 0)


@pytest.mark.parametrize("late", [False, True])
def test_what_comes_piece_by_piece_is_shared_tick_by_tick(tmp_path: Path, late: bool) -> None:
    """In a tick that would be late with more, there is less of it."""
    (tmp_path / "flight-000.ulg").write_bytes(bytes(range(1, 256)) * 2_000)
    hub, autopilot, clock = MemoryHub(), KinematicAutopilot(), SimClock()
    log = UlogFlightLog(tmp_path / "flight-001.ulg", autopilot.parameters, 0, 0)
    autopilot.logs = folder = log.folder
    server = MavlinkServer([gcs_link(hub)], autopilot, boot_unix_us=0, clock=clock)
    clients = [hub.client(port, (100 + port, 190)) for port in range(CLIENTS)]
    got = [0] * CLIENTS
    pieces = LEAST_PIECES_PER_TICK if late else PIECES_PER_TICK
    with closing(log), closing(folder):
        for client in clients:
            client.send(dialect.MAVLink_log_request_data_message(1, 1, 0, 0, 0xFFFF_FFFF))
        for _ in range(100):
            clock.sleep_until(autopilot.time_us + late * TICK_US)
            server.receive(autopilot.time_us)
            autopilot.step()
            server.send(autopilot.time_us)
            in_tick = 0
            for n, client in enumerate(clients):
                frames = [frame for frame in client.endpoint.take() if frame[7:10] == LOG_DATA]
                for frame in frames:
                    offset = int.from_bytes(frame[10:14], "little")
                    assert offset == 90 * got[n]  # whole, and in order
                    got[n] += 1
                in_tick += len(frames)
            assert pieces <= in_tick < pieces + PACKETS_PER_TICK
    assert max(got) - min(got) <= PACKETS_PER_TICK
