"""One client's part in MAVLink FTP: requests, the file that it has open, errors."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from enum import IntEnum
from typing import BinaryIO, Protocol

SESSION = 0
"""Number of a client's only session, as of PX4's."""


class Code(IntEnum):
    """Error codes in the first byte of a NAK."""

    FAIL = 1
    FAIL_ERRNO = 2
    INVALID_DATA_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS = 5
    END_OF_FILE = 6
    UNKNOWN_COMMAND = 7
    FILE_EXISTS = 8
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


class RefusedError(Exception):
    """A request that is answered with a NAK."""

    def __init__(self, code: Code) -> None:
        super().__init__(code.name)
        self.code = code


@dataclass(slots=True)
class Request:
    """One request, unpacked."""

    session: int
    opcode: int
    offset: int
    size: int
    """Of the data; in a read, how much is wanted."""
    data: bytes

    @property
    def name(self) -> str:
        """The path that is meant."""
        return os.fsdecode(self.data.split(b"\0", 1)[0])


@dataclass(slots=True)
class Session:
    """The file that a client has open."""

    file: BinaryIO | None = None
    size: int = 0
    """Of the file when it was opened [bytes]."""

    def opened(self, request: Request) -> BinaryIO:
        """Return the open file. Raises RefusedError when there is none."""
        if request.session != SESSION or self.file is None:
            raise RefusedError(Code.INVALID_SESSION)
        return self.file

    def close(self) -> None:
        """Close the file, if there is one."""
        if self.file is not None:
            self.file.close()
            self.file = None


@dataclass(slots=True)
class Burst:
    """A burst read that is going on."""

    sequence: int
    offset: int
    asker: tuple[int, int]


class Sum(Protocol):
    """A checksum that is being worked out."""

    def go_on(self) -> bytes | None:
        """Return the data of the answer, None while it is not known. Raises OSError."""
        ...

    def close(self) -> None:
        """Release what is held."""
        ...


@dataclass(slots=True)
class Summing:
    """A request for a checksum that is not yet answered."""

    sequence: int
    session: int
    offset: int
    asker: tuple[int, int]
    sum: Sum


@dataclass(slots=True)
class FtpClient:
    """One client's part in MAVLink FTP."""

    session: Session = field(default_factory=Session)
    burst: Burst | None = None
    summing: Summing | None = None
    used_us: int = 0
    last_sequence: int | None = None
    """Of the request that `last_answer` answered."""
    last_answer: bytes = b""

    def close(self) -> None:
        """Close what is open."""
        self.session.close()
        self.stop_summing()

    def stop_summing(self) -> None:
        """Forget a checksum that is being worked out, if there is one."""
        if self.summing is not None:
            self.summing.sum.close()
            self.summing = None
