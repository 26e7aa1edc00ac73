"""MAVLink 2 signing, which MAVSDK lacks: a UDP proxy on its own thread, in MAVSDK's place."""

from __future__ import annotations

import re
import select
import socket
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from airl_mav.core.errors import UsageError
from airl_mav.core.ports import LOOPBACK
from airl_mav.core.signing import StoredSigning, frames_of
from companion.interfaces import LinkError

LINK_ID = 2
"""In the signatures of a companion; the flight controller's links are 0 and 1."""

MAX_DATAGRAM = 4096
POLL_S = 0.5
"""Longest wait before it is looked whether to end [wall s]."""

_URL = re.compile(r"udp(?:in)?://(?P<host>[^:/]*):(?P<port>\d+)")


@contextmanager
def signed(url: str, key: Path | None) -> Iterator[str]:
    """Yield the URL for MAVSDK: the original, or that of a proxy that signs with a key."""
    if key is None:
        yield url
        return
    with closing(SigningProxy(url, key)) as proxy:
        try:
            yield proxy.url
        except LinkError as error:
            told = str(error).replace(proxy.url, url)
            refused = proxy.refused
            hint = f" ({refused} frames refused: bad signature)" if refused else ""
            raise LinkError(told + hint) from None


class SigningProxy:
    """Passes a flight controller's verified frames to MAVSDK, and MAVSDK's, signed, back."""

    def __init__(self, url: str, key: Path) -> None:
        """Bind and start the proxy of udpin://HOST:PORT, of this machine without a host."""
        found = _URL.fullmatch(url)
        if found is None:
            raise UsageError(f"--connect {url}: with a signing key: udpin://HOST:PORT")
        self._stored = StoredSigning(key)
        self._vehicle: tuple[str, int] | None = None
        self._outer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._inner = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._outer.bind((found["host"] or LOOPBACK, int(found["port"])))
            self._inner.bind((LOOPBACK, 0))
            # Where MAVSDK will listen: it replies to who sends to it.
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind((LOOPBACK, 0))
                self._mavsdk: tuple[str, int] = probe.getsockname()
        except OSError as error:
            self._outer.close()
            self._inner.close()
            raise UsageError(f"--connect {url}: {error.strerror}") from None
        self.url = f"udpin://{LOOPBACK}:{self._mavsdk[1]}"
        """What MAVSDK connects to."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="signing", daemon=True)
        self._thread.start()

    @property
    def refused(self) -> int:
        """Frames that did not come from the flight controller with the key, or came twice."""
        return self._stored.signing.refused

    def close(self) -> None:
        """End, and keep the newest time stamp; harmless when called again."""
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join()
            self._outer.close()
            self._inner.close()
            self._stored.save()

    def _run(self) -> None:
        while not self._stop.is_set():
            ready, _, _ = select.select((self._outer, self._inner), (), (), POLL_S)
            for end in ready:
                try:
                    data, address = end.recvfrom(MAX_DATAGRAM)
                    if end is self._outer:
                        self._from_vehicle(data, address)
                    elif address == self._mavsdk:
                        # Anybody else on this machine would have its frames signed.
                        self._from_mavsdk(data)
                except OSError:
                    continue  # nobody listens there yet
            self._stored.save_due()

    def _from_vehicle(self, data: bytes, address: tuple[str, int]) -> None:
        accepted = [frame for frame in frames_of(data) if self._stored.signing.accepts(frame)]
        if any(frame[2] & 1 for frame in accepted):
            self._vehicle = address  # not by an unsigned heartbeat
        if accepted:
            # What comes together goes on together: in lockstep a second of telemetry comes at
            # once, and frame by frame it would not fit into MAVSDK's socket.
            self._inner.sendto(b"".join(accepted), self._mavsdk)

    def _from_mavsdk(self, data: bytes) -> None:
        if self._vehicle is None:
            return
        for frame in frames_of(data):
            self._outer.sendto(self._stored.signing.sign(frame, LINK_ID), self._vehicle)
