"""Unused ports, so that tests run side by side."""

from __future__ import annotations

import fcntl
import random
import socket
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

LOOPBACK = "127.0.0.1"

CONDUCTED_INSTANCE = 8
"""Instance of PX4's, and the next one, of tests that bind its ports themselves."""


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


@contextmanager
def reserved_instance() -> Iterator[int]:
    """Reserve one of PX4's instance numbers, which fix its ports, and yield it.

    No test of another worker or checkout gets the same instance: seconds pass between the search
    for free ports and their use by a starting program. Instance 0 is never used: a developer may
    fly it on this machine.
    """
    instances = list(range(1, CONDUCTED_INSTANCE))
    random.SystemRandom().shuffle(instances)
    for instance in instances:
        with _lock_of(instance) as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            if _ports_are_free(instance):
                yield instance
                return
    raise AssertionError("no instance is free")


@contextmanager
def reserved_conducted() -> Iterator[None]:
    """Reserve `CONDUCTED_INSTANCE` and the next one; another checkout's tests are waited for."""
    with _lock_of(CONDUCTED_INSTANCE) as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _lock_of(instance: int) -> TextIO:
    """Open the file whose lock reserves an instance; the lock always ends with the process."""
    return (Path(tempfile.gettempdir()) / f"airl-mav-tests-px4-{instance}.lock").open("a")


def _ports_are_free(instance: int) -> bool:
    with ExitStack() as held:
        try:
            tcp = held.enter_context(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
            tcp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tcp.bind((LOOPBACK, 4560 + instance))
            for port in (14540, 14580, 18570, 14280, 14030, 13030):
                udp = held.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                udp.bind((LOOPBACK, port + instance))
        except OSError:
            return False
    return True


@dataclass(frozen=True)
class TestPorts:
    """The ports of one rehearsal."""

    __test__ = False  # not a test class, despite its name

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
