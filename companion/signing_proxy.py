"""MAVLink 2 signing, which MAVSDK lacks: a UDP proxy between vehicle and MAVSDK, on a thread."""

from __future__ import annotations

import re
import select
import socket
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from airl_mav.core.constants import LOOPBACK
from airl_mav.core.errors import UsageError
from airl_mav.core.signing import StoredSigning, frames_of
from companion.link_interface import LinkError

LINK_ID = 2
"""Link id in signatures of a companion; the flight controller's links are 0 and 1."""

MAX_DATAGRAM = 4096
POLL_S = 0.5
"""Maximum wait between checks for the end [wall s]."""

_URL = re.compile(r"udp(?:in)?://(?P<host>[^:/]*):(?P<port>\d+)")


@contextmanager
def signed(url: str, key: Path | None) -> Iterator[str]:
    """Yield the URL for MAVSDK: the original URL, or a proxy's URL that signs with a key."""
    if key is None:
        yield url
        return
    with closing(SigningProxy(url, key)) as proxy:
        try:
            yield proxy.url
        except LinkError as error:
            # Error messages name the URL that the user has given.
            told = str(error).replace(proxy.url, url)
            refused = proxy.refused
            hint = f" ({refused} frames refused: bad signature)" if refused else ""
            raise LinkError(told + hint) from None


class SigningProxy:
    """Proxy that passes verified frames to MAVSDK, and MAVSDK's frames, signed, to the vehicle."""

    def __init__(self, url: str, key: Path) -> None:
        """Bind and start the proxy of udpin://HOST:PORT; the default host is this machine."""
        # Signing works on datagrams, so serial connections are not supported.
        found = _URL.fullmatch(url)
        if found is None:
            raise UsageError(f"--connect {url}: with a signing key: udpin://HOST:PORT")
        self._stored = StoredSigning(key)
        self._vehicle: tuple[str, int] | None = None
        self._outer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._inner = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            # Outer socket: the vehicle's port. Inner socket: a free port towards MAVSDK.
            self._outer.bind((found["host"] or LOOPBACK, int(found["port"])))
            self._inner.bind((LOOPBACK, 0))
            # A free port for MAVSDK to listen on; MAVSDK replies to the sender.
            # The probe closes at once; MAVSDK binds the port a moment later.
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind((LOOPBACK, 0))
                self._mavsdk: tuple[str, int] = probe.getsockname()
        except OSError as error:
            self._outer.close()
            self._inner.close()
            raise UsageError(f"--connect {url}: {error.strerror}") from None
        self.url = f"udpin://{LOOPBACK}:{self._mavsdk[1]}"
        """URL for MAVSDK."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="signing", daemon=True)
        self._thread.start()

    @property
    def refused(self) -> int:
        """Number of frames rejected for an invalid signature or as duplicates."""
        return self._stored.signing.refused

    def close(self) -> None:
        """Stop the proxy and store the newest time stamp. Idempotent."""
        # The stamp is stored last: a reused time stamp would be rejected after a restart.
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join()
            self._outer.close()
            self._inner.close()
            self._stored.save()

    def _run(self) -> None:
        while not self._stop.is_set():
            # A finite timeout lets the loop see `_stop`.
            ready, _, _ = select.select((self._outer, self._inner), (), (), POLL_S)
            for end in ready:
                try:
                    data, address = end.recvfrom(MAX_DATAGRAM)
                    if end is self._outer:
                        self._from_vehicle(data, address)
                    elif address == self._mavsdk:
                        # Frames of other programs on this machine must not be signed.
                        self._from_mavsdk(data)
                except OSError:
                    continue  # no listener yet
            self._stored.save_due()

    def _from_vehicle(self, data: bytes, address: tuple[str, int]) -> None:
        accepted = [frame for frame in frames_of(data) if self._stored.signing.accepts(frame)]
        # Byte 2 holds the incompatibility flags; bit 0 marks a signed frame.
        if any(frame[2] & 1 for frame in accepted):
            self._vehicle = address  # an unsigned heartbeat does not set the address
        if accepted:
            # Frames are forwarded together: in lockstep, a second of telemetry arrives at once and
            # would overflow MAVSDK's socket as single frames.
            self._inner.sendto(b"".join(accepted), self._mavsdk)

    def _from_mavsdk(self, data: bytes) -> None:
        if self._vehicle is None:
            return
        for frame in frames_of(data):
            self._outer.sendto(self._stored.signing.sign(frame, LINK_ID), self._vehicle)
