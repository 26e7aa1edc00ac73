"""MAVLink FTP."""

from __future__ import annotations

import tempfile
from pathlib import Path
from queue import Queue
from typing import Any

from mavsdk.plugins.ftp import Ftp, FtpResult

from tests.support.px4_walk.row import Row
from tests.support.px4_walk.vehicle import RefusedError, Vehicle

AREA = "ftp"
_TEXT = b"a file of some length\n" * 40
_FOLDER = "airl_walk"
_METADATA = "/etc/extras/component_general.json.xz"


def _transferred(start: Any, *words: Any) -> FtpResult:
    results: Queue[FtpResult] = Queue()
    start(*words, lambda result, *_: results.put(result))
    while (result := results.get(timeout=30.0)) is FtpResult.NEXT:
        pass
    if result is not FtpResult.SUCCESS:
        raise RefusedError(result.name)
    return result


def _upload(vehicle: Vehicle) -> FtpResult:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "up.txt"
        path.write_bytes(_TEXT)
        return _transferred(vehicle.plugin(Ftp).upload_async, str(path), _FOLDER)


def _download(name: str, *, burst: bool) -> Any:
    def make(vehicle: Vehicle) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            _transferred(vehicle.plugin(Ftp).download_async, name, folder, burst)
            return (Path(folder) / Path(name).name).read_bytes()

    return make


def _whole(found: bytes) -> bool:
    return found == _TEXT


def _list(name: str) -> Any:
    return lambda v: [str(e.name) for e in v.plugin(Ftp).list_directory(name).entries]


_UP, _MOVED = f"{_FOLDER}/up.txt", f"{_FOLDER}/up2.txt"

ROWS = (
    Row(AREA, "list_directory /", _list("/"), check=bool),
    Row(AREA, "list_directory .", _list(".")),
    Row(AREA, "list_directory /no/such/dir", _list("/no/such/dir"), ("FILE_DOES_NOT_EXIST",)),
    Row(AREA, "create_directory", lambda v: v.plugin(Ftp).create_directory(_FOLDER)),
    Row(AREA, "upload", _upload),
    Row(AREA, "list_directory", _list(_FOLDER), check=lambda found: found == ["up.txt"]),
    Row(AREA, "rename", lambda v: v.plugin(Ftp).rename(_UP, _MOVED)),
    Row(AREA, "download", _download(_MOVED, burst=False), check=_whole),
    Row(AREA, "download in a burst", _download(_MOVED, burst=True), check=_whole),
    Row(
        AREA,
        "download of what is not there",
        _download(_UP, burst=False),
        ("FILE_DOES_NOT_EXIST",),
    ),
    Row(AREA, "remove_file", lambda v: v.plugin(Ftp).remove_file(_MOVED)),
    Row(AREA, "remove_directory", lambda v: v.plugin(Ftp).remove_directory(_FOLDER)),
    Row(
        AREA,
        "download of the component metadata",
        _download(_METADATA, burst=True),
        check=lambda found: found.startswith(b"\xfd7zXZ"),
    ),
)
