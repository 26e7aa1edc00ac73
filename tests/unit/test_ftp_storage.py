"""Files of the vehicle for MAVLink FTP: quota, folders, sessions."""

from __future__ import annotations

import errno
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware_sim.addons.ground_station_services import files
from firmware_sim.addons.ground_station_services.files import (
    CHUNK_BYTES,
    DATA_BYTES,
    OPERATIONS,
    Code,
    FtpRequest,
    RefusedError,
    Session,
    Storage,
)

(NOTHING, TERMINATE, RESET, LIST, OPEN, READ, CREATE) = range(7)
WRITE, REMOVE, MAKE_FOLDER, REMOVE_FOLDER, OPEN_TO_WRITE, TRUNCATE, RENAME = range(7, 14)


class Client:
    """Client with one session, whose requests go straight to the operations."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.storage = Storage(folder)
        self.session = Session()

    def ask(
        self, opcode: int, data: bytes = b"", offset: int = 0, size: int = 0, at: int = 0
    ) -> bytes:
        request = FtpRequest(1, at, opcode, offset, size, data, (255, 190))
        return OPERATIONS[opcode](request, self.session, self.storage)

    def refused(self, opcode: int, data: bytes = b"", offset: int = 0, at: int = 0) -> Code:
        with pytest.raises(RefusedError) as caught:
            self.ask(opcode, data, offset, DATA_BYTES, at)
        return caught.value.code

    def full(self, opcode: int, data: bytes = b"", offset: int = 0) -> bool:
        try:
            self.ask(opcode, data, offset)
        except OSError as error:
            assert error.errno == errno.ENOSPC
            return True
        return False


@pytest.fixture
def client(tmp_path: Path) -> Iterator[Client]:
    found = Client(tmp_path)
    yield found
    found.session.close()


def test_files_in_nested_folders_count(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    deep = client.folder / "a" / "b" / "c"
    deep.mkdir(parents=True)
    (deep / "one").write_bytes(bytes(60))
    (client.folder / "two").write_bytes(bytes(30))
    monkeypatch.setattr(files, "GREATEST_BYTES", 100)
    client.storage.check_room(10)
    with pytest.raises(OSError, match="No space left"):
        client.storage.check_room(11)
    (deep / "one").unlink()
    client.storage.check_room(70)


def test_folders_and_files_count_together(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "GREATEST_FILES", 4)
    assert not client.full(MAKE_FOLDER, b"a")
    assert not client.full(MAKE_FOLDER, b"a/b")
    assert not client.full(CREATE, b"a/b/c")
    client.ask(RESET)
    assert not client.full(CREATE, b"a/b/d")
    client.ask(RESET)
    assert client.full(MAKE_FOLDER, b"e")
    assert client.full(CREATE, b"a/e")
    client.ask(REMOVE, b"a/b/d")
    assert not client.full(CREATE, b"a/e")


def test_links_neither_count_nor_lead_anywhere(
    client: Client, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    outside = tmp_path_factory.mktemp("outside")
    (outside / "large").write_bytes(bytes(1000))
    (client.folder / "folder").symlink_to(outside)
    (client.folder / "file").symlink_to(outside / "large")
    monkeypatch.setattr(files, "GREATEST_BYTES", 500)
    client.storage.check_room(100)
    for name in ("folder", "file", "folder/large", ".."):
        with pytest.raises(PermissionError):
            client.storage.path(name)
    assert client.ask(LIST, b"/") == b"S\0S\0"


def test_only_growth_needs_room(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    (client.folder / "log").write_bytes(bytes(80))
    monkeypatch.setattr(files, "GREATEST_BYTES", 80)
    assert client.full(TRUNCATE, b"log", 81)
    monkeypatch.setattr(files, "GREATEST_BYTES", 90)
    assert client.full(TRUNCATE, b"log", 91)
    assert not client.full(TRUNCATE, b"log", 90)
    monkeypatch.setattr(files, "GREATEST_BYTES", 10)
    assert not client.full(TRUNCATE, b"log", 90)
    assert not client.full(TRUNCATE, b"log", 50)
    assert (client.folder / "log").stat().st_size == 50


def test_a_growing_file_is_checked_once_a_chunk(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "GREATEST_BYTES", CHUNK_BYTES + 5)
    assert client.ask(CREATE, b"log") == struct.pack("<I", 0)
    assert client.ask(WRITE, b"x" * 10, CHUNK_BYTES - 10) == struct.pack("<I", 10)
    assert client.session.size == CHUNK_BYTES
    # Overwritten: no growth.
    assert client.ask(WRITE, b"y" * 10, 0) == struct.pack("<I", 10)
    assert client.session.size == CHUNK_BYTES
    assert client.full(WRITE, b"x" * 10, 2 * CHUNK_BYTES - 5)
    client.ask(WRITE, b"z" * 5, CHUNK_BYTES)
    data = (client.folder / "log").read_bytes()
    assert len(data) == CHUNK_BYTES + 5
    assert data[:10] == b"y" * 10
    assert data[-15:] == b"x" * 10 + b"z" * 5
    monkeypatch.setattr(files, "GREATEST_BYTES", 10)
    assert client.full(WRITE, b"x" * 10, 2 * CHUNK_BYTES)


def test_small_growth_within_a_chunk_is_not_checked(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The check scans the storage: once a chunk, not at every message."""
    client.ask(CREATE, b"log")
    client.ask(WRITE, b"x" * 10, CHUNK_BYTES + 10)
    checks: list[int] = []
    monkeypatch.setattr(Storage, "check_room", lambda self, more: checks.append(more))
    for offset in range(20, 2000, 10):
        client.ask(WRITE, b"x" * 10, CHUNK_BYTES + offset)
    assert checks == []
    client.ask(WRITE, b"x" * 10, 2 * CHUNK_BYTES)
    assert checks == [2 * CHUNK_BYTES + 10 - (CHUNK_BYTES + 2000)]


def test_a_listing_continues_where_it_ended(client: Client) -> None:
    names = [f"{i:03d}-{'n' * 60}" for i in range(7)]
    for name in names:
        (client.folder / name).write_bytes(bytes(7))
    (client.folder / "a").mkdir()
    found, offset = b"", 0
    while len(entries := found.split(b"\0")) <= 8:
        part = client.ask(LIST, b"/", offset)
        assert len(part) <= DATA_BYTES
        found += part
        offset += part.count(b"\0")
    assert entries[:-1] == [b"F" + name.encode() + b"\t7" for name in names] + [b"Da"]
    assert client.refused(LIST, b"/", offset) is Code.END_OF_FILE
    assert client.refused(LIST, b"nowhere") is Code.FILE_NOT_FOUND


def test_an_entry_may_fill_a_message(client: Client) -> None:
    (client.folder / ("n" * (DATA_BYTES - 2))).mkdir()
    assert len(client.ask(LIST, b"/")) == DATA_BYTES


def test_a_session_is_one_file(client: Client) -> None:
    (client.folder / "log").write_bytes(b"0123456789")
    assert client.refused(READ) is Code.INVALID_SESSION
    assert client.refused(TERMINATE) is Code.INVALID_SESSION
    assert client.ask(OPEN, b"log") == struct.pack("<I", 10)
    for opcode in (OPEN, CREATE, OPEN_TO_WRITE):
        assert client.refused(opcode, b"log") is Code.NO_SESSIONS
    assert client.refused(READ, at=1) is Code.INVALID_SESSION
    assert client.ask(READ, size=4, offset=3) == b"3456"
    assert client.ask(READ, size=200, offset=3) == b"3456789"
    assert client.refused(READ, offset=10) is Code.END_OF_FILE
    assert client.ask(TERMINATE) == b""
    assert client.session.file is None
    assert client.ask(OPEN_TO_WRITE, b"log") == struct.pack("<I", 10)
    assert client.ask(RESET) == b""
    assert client.ask(RESET) == b""
    assert client.ask(CREATE, b"log") == struct.pack("<I", 0)
    client.ask(RESET)
    with pytest.raises(IsADirectoryError):
        client.ask(OPEN, b"/")
    assert client.session.file is None


def test_a_new_file_has_the_usual_permissions(client: Client) -> None:
    client.ask(CREATE, b"log")
    (client.folder / "usual").touch()
    modes = {(client.folder / name).stat().st_mode for name in ("log", "usual")}
    assert len(modes) == 1


def test_a_message_holds_no_more_than_its_size(client: Client) -> None:
    (client.folder / "log").write_bytes(bytes(1000))
    client.ask(OPEN, b"log")
    assert len(client.ask(READ, size=255)) == DATA_BYTES


def test_names_of_a_rename(client: Client) -> None:
    (client.folder / "a").write_bytes(b"1")
    client.ask(RENAME, b"a\0b\0c")
    assert (client.folder / "b").read_bytes() == b"1"
    for data in (b"b", b"b\0", b"b\0\0c"):
        with pytest.raises(OSError, match="Invalid argument"):
            client.ask(RENAME, data)
    for data in (b"b\0etc/b", b"etc/a\0b", b"b\0/", b"b\0.."):
        with pytest.raises((RefusedError, PermissionError)):
            client.ask(RENAME, data)
    assert [path.name for path in client.folder.iterdir()] == ["b"]


@pytest.mark.parametrize("opcode", [CREATE, OPEN_TO_WRITE, REMOVE, MAKE_FOLDER, TRUNCATE])
def test_the_root_and_the_vehicles_files_are_protected(client: Client, opcode: int) -> None:
    (client.folder / "etc").mkdir()
    (client.folder / "etc" / "x").write_bytes(b"1")
    for name in (b"", b"/", b".", b"etc", b"etc/x", b"/etc/./x", b"etc/new"):
        assert client.refused(opcode, name) is Code.FILE_PROTECTED
    assert (client.folder / "etc" / "x").read_bytes() == b"1"
    assert client.ask(OPEN, b"etc/x") == struct.pack("<I", 1)


def test_a_folder_is_made_and_removed(client: Client) -> None:
    assert client.ask(MAKE_FOLDER, b"a") == b""
    assert (client.folder / "a").is_dir()
    assert client.ask(REMOVE_FOLDER, b"a") == b""
    assert not (client.folder / "a").exists()
    assert client.ask(NOTHING) == b""


def test_a_temporary_folder_alone_is_removed(tmp_path: Path) -> None:
    given = Storage(tmp_path)
    given.close()
    assert tmp_path.is_dir()
    assert given.folder == tmp_path
    storage = Storage()
    storage.close()
    folder = storage.folder
    assert folder == storage.folder
    (folder / "x").write_bytes(b"1")
    assert storage.path("/x") == storage.path("./x") == folder / "x"
    storage.close()
    assert not folder.exists()
    assert storage.folder != folder
    storage.close()
