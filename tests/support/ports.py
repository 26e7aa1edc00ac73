"""Ports that nobody uses, so that tests run side by side."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from dataclasses import dataclass

LOOPBACK = "127.0.0.1"


def free_ports(udp: int, tcp: int) -> tuple[list[int], list[int]]:
    """Return free UDP and TCP ports of the loopback address, all different."""
    with ExitStack() as held:
        found: list[list[int]] = []
        for kind, number in ((socket.SOCK_DGRAM, udp), (socket.SOCK_STREAM, tcp)):
            sockets = [
                held.enter_context(socket.socket(socket.AF_INET, kind)) for _ in range(number)
            ]
            for each in sockets:
                each.bind((LOOPBACK, 0))
            found.append([each.getsockname()[1] for each in sockets])
    return found[0], found[1]


@dataclass(frozen=True)
class TestPorts:
    """The ports of one rehearsal."""

    __test__ = False  # not a test class, whatever its name

    api: int
    api_local: int
    gcs: int
    gcs_local: int
    camera: int

    def options(self) -> list[str]:
        """Return the command line options of airl-sitl and airl-firmware."""
        return [
            *("--api-port", str(self.api), "--api-local-port", str(self.api_local)),
            *("--gcs-port", str(self.gcs), "--gcs-local-port", str(self.gcs_local)),
            *("--camera-port", str(self.camera)),
        ]


def choose_ports(gcs: int | None = None) -> TestPorts:
    """Return free ports; `gcs` is taken as it is when a test listens there."""
    (api, api_local, free_gcs, gcs_local), (camera,) = free_ports(4, 1)
    return TestPorts(api, api_local, free_gcs if gcs is None else gcs, gcs_local, camera)
