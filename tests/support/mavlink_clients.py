"""Clients for tests of the MAVLink side: raw pymavlink, and the real MAVSDK over raw:// or UDP."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from mavsdk import ComponentType, Configuration, Mavsdk

from airl_mav.core.constants import TICK_US, US_PER_S
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint, SharedEndpoint
from firmware_sim.mavlink.px4_links import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from tests.support.kinematic_autopilot import KinematicAutopilot

PATIENT_US = 10 * US_PER_S
"""Offboard-loss time for tests with MAVSDK, whose 20 Hz is wall time and may stall under load."""

BOOT_UNIX_US = 1_700_000_000_000_000
CLIENT_IDS = (245, 190)


class Bench:
    """A server over two in-memory links, a kinematic autopilot, and a clock moved by hand."""

    def __init__(
        self, onboard: SharedEndpoint | None = None, autopilot: KinematicAutopilot | None = None
    ) -> None:
        self.onboard = onboard if onboard is not None else MemoryEndpoint()
        self.gcs = MemoryEndpoint()
        self.autopilot = autopilot or KinematicAutopilot()
        self.server = MavlinkServer(
            [onboard_link(self.onboard), gcs_link(self.gcs)],
            self.autopilot,
            boot_unix_us=BOOT_UNIX_US,
        )

    @property
    def memory(self) -> MemoryEndpoint:
        """The onboard endpoint, where it is in memory."""
        assert isinstance(self.onboard, MemoryEndpoint)
        return self.onboard

    def tick(self) -> None:
        """Receive, step, send."""
        self.server.receive(self.autopilot.time_us)
        self.autopilot.step()
        self.server.send(self.autopilot.time_us)

    def run(self, seconds: float) -> None:
        """Tick for some simulated seconds."""
        for _ in range(round(seconds * US_PER_S / TICK_US)):
            self.tick()


class RawClient:
    """Speaks pymavlink into one in-memory endpoint; parses with pymavlink's own parser."""

    def __init__(self, endpoint: MemoryEndpoint, ids: tuple[int, int] = CLIENT_IDS) -> None:
        self.endpoint = endpoint
        self.mav = dialect.MAVLink(None, *ids)
        self.mav.robust_parsing = True

    def pack(self, message: Any) -> bytes:
        """Return the frame of a message."""
        frame: bytes = message.pack(self.mav)
        self.mav.seq = (self.mav.seq + 1) % 256
        return frame

    def send(self, message: Any) -> None:
        """Send a message to the vehicle."""
        self.endpoint.inbox.append(self.pack(message))

    def command(self, number: int, *params: float, target: tuple[int, int] = (1, 1)) -> None:
        """Send a COMMAND_LONG; parameters not given are NaN."""
        filled = [*params, *[float("nan")] * (7 - len(params))]
        self.send(dialect.MAVLink_command_long_message(*target, number, 0, *filled))

    def received(self, *names: str) -> list[Any]:
        """Return what has come since the last call, only the named messages if any are named."""
        messages = []
        for frame in self.endpoint.take():
            parsed = self.mav.parse_buffer(frame)
            assert parsed is not None
            messages += parsed
        assert not [m for m in messages if m.get_type() == "BAD_DATA"]
        return [m for m in messages if not names or m.get_type() in names]

    def count(self) -> Counter[str]:
        """Return how many of each message have come since the last call."""
        return Counter(message.get_type() for message in self.received())


def text_of(messages: list[Any]) -> list[tuple[int, str]]:
    """Return (severity, text) of each STATUSTEXT."""
    said = [m for m in messages if m.get_type() == "STATUSTEXT"]
    # A tab ends what is an event, too: tests/firmware/test_events.py looks at it.
    return [(m.severity, m.text.removesuffix("\t")) for m in said]


class Rig:
    """A ready vehicle and a raw client on its onboard link."""

    def __init__(self, autopilot: KinematicAutopilot | None = None) -> None:
        self.bench = Bench(autopilot=autopilot)
        self.autopilot = self.bench.autopilot
        self.client = RawClient(self.bench.memory)
        self.station = RawClient(self.bench.gcs)
        self.bench.run(0.2)
        self.client.received()
        self.station.received()

    def exchange(self, message: Any) -> list[Any]:
        """Send a message, run one tick, return everything that came back."""
        self.client.send(message)
        self.bench.tick()
        return self.client.received()

    def command(self, number: int, *params: float) -> tuple[int, list[Any]]:
        """Send a COMMAND_LONG; return its result and everything that came back in that tick."""
        self.client.command(number, *params)
        self.bench.tick()
        return self.acknowledged(number)

    def acknowledged(self, number: int) -> tuple[int, list[Any]]:
        messages = self.client.received()
        (ack,) = [m for m in messages if m.get_type() == "COMMAND_ACK"]
        assert ack.command == number
        assert (ack.target_system, ack.target_component) == CLIENT_IDS
        return ack.result, messages

    def climb(self) -> None:
        """Arm, take off, hold."""
        assert self.command(400, 1)[0] == Result.ACCEPTED
        assert self.command(22)[0] == Result.ACCEPTED
        self.bench.run(3.0)
        assert self.autopilot.mode is Mode.HOLD
        self.client.received()

    def set_local(self, mask: int, frame: int = 1, **fields: float) -> None:
        """Send SET_POSITION_TARGET_LOCAL_NED; fields not given are 0."""
        order = ("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
        values = [fields.get(name, 0.0) for name in order]
        self.client.send(
            dialect.MAVLink_set_position_target_local_ned_message(7, 1, 1, frame, mask, *values)
        )


class Pacer:
    """Ticks a bench on its own thread at a multiple of real time, so that MAVSDK can wait."""

    def __init__(self, bench: Bench, speed: float = 8.0) -> None:
        self.bench = bench
        self.lock = threading.Lock()
        """Hold it to look at or change the autopilot from the test."""
        self.error: BaseException | None = None
        self._pause_s = TICK_US / US_PER_S / speed
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pacer", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        if self.error is not None:
            raise self.error

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                with self.lock:
                    self.bench.tick()
                time.sleep(self._pause_s)
        except BaseException as error:  # shown to the test by stop()
            self.error = error


class RawLane(MemoryEndpoint):
    """An endpoint whose other end is MAVSDK's raw:// connection."""

    def __init__(self) -> None:
        super().__init__()
        self.mavsdk: Mavsdk | None = None
        self.sent: Counter[int] = Counter()
        """Frames to MAVSDK per message id."""

    def send(self, data: bytes) -> None:
        self.sent[int.from_bytes(data[7:10], "little")] += 1
        if self.mavsdk is not None:
            self.mavsdk.pass_received_raw_bytes(data)

    def send_streams(self, frames: Sequence[bytes]) -> None:
        for frame in frames:
            self.send(frame)


class Companion:
    """MAVSDK instance and its first autopilot, with the plugins required by a test."""

    def __init__(self, mavsdk: Mavsdk) -> None:
        self.mavsdk = mavsdk
        system = mavsdk.first_autopilot(10.0)
        assert system is not None, "MAVSDK found no autopilot"
        self.system = system
        self._plugins: list[Any] = []

    def plugin(self, kind: Any) -> Any:
        """Return a plugin instance that is destroyed with the companion."""
        plugin = kind(self.system)
        self._plugins.append(plugin)
        return plugin

    def destroy(self) -> None:
        """Release the plugins, the system and MAVSDK, in that order."""
        for plugin in self._plugins:
            plugin.destroy()
        self._plugins.clear()
        self.mavsdk.destroy()


def _new_mavsdk(component: ComponentType) -> Mavsdk:
    return Mavsdk(Configuration.create_with_component_type(component))


@contextmanager
def mavsdk_over_memory(
    component: ComponentType = ComponentType.COMPANION_COMPUTER,
    autopilot: KinematicAutopilot | None = None,
) -> Iterator[tuple[Companion, Pacer]]:
    """Yield MAVSDK connected to a ticking bench through raw://."""
    lane = RawLane()
    pacer = Pacer(Bench(lane, autopilot))
    mavsdk = _new_mavsdk(component)
    assert mavsdk.add_any_connection("raw://") == 0
    # The callback runs on MAVSDK's io thread: it must only append, never wait.
    mavsdk.subscribe_raw_bytes_to_be_sent(lane.inbox.append)
    lane.mavsdk = mavsdk
    with _flying(mavsdk, pacer) as companion:
        yield companion, pacer


@contextmanager
def mavsdk_over_udp(endpoint: SharedEndpoint, url: str) -> Iterator[tuple[Companion, Pacer]]:
    """Yield MAVSDK connected to a ticking bench through a UDP endpoint."""
    pacer = Pacer(Bench(endpoint))
    mavsdk = _new_mavsdk(ComponentType.COMPANION_COMPUTER)
    assert mavsdk.add_any_connection(url) == 0
    with _flying(mavsdk, pacer) as companion:
        yield companion, pacer


@contextmanager
def _flying(mavsdk: Mavsdk, pacer: Pacer) -> Iterator[Companion]:
    companion: Companion | None = None
    pacer.bench.autopilot.offboard_loss_us = PATIENT_US
    pacer.start()
    try:
        companion = Companion(mavsdk)
        yield companion
    finally:
        # Stop the feed before MAVSDK is destroyed.
        pacer.stop()
        if companion is None:
            mavsdk.destroy()
        else:
            companion.destroy()
        pacer.bench.server.close()


def wait_for(condition: Callable[[], bool], timeout_s: float = 20.0) -> None:
    """Return once the condition holds; fail after the timeout."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.005)
