"""Files that survive kills, full disks and bit errors: atomic writes, checked reads.

A file is written under a temporary name, synced to the disk and renamed. A reader sees the old file
or the complete new file. Lines and arrays of a run are appended; the end that a kill cut short is
ignored. A run folder may come from an untrusted source: links in it are replaced or rejected. JSON
objects contain their CRC-32 in the field `crc32`; archive members have a CRC by format. Damaged
data is rejected on reading with one line. Files without the field, by earlier versions of this
package or edited by hand, are read unchecked. A `LogFile` grows during a flight, under a temporary
name until it is complete.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import io
import json
import os
import secrets
import shutil
import stat
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import groupby
from pathlib import Path
from typing import IO, Any, NamedTuple, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from airl_mav.core.constants import US_PER_S
from airl_mav.core.errors import UsageError, usage_errors
from airl_mav.core.fields import field_error

T = TypeVar("T")
Arrays = dict[str, NDArray[Any]]

CRC = "crc32"
"""Field of a JSON object: CRC-32 (zlib) of the other fields as compact ASCII JSON, hexadecimal."""

DEEPEST = 100
"""Maximum nesting of lists and tables in a JSON file."""

JSON_BYTES, LINES_BYTES = 16 << 20, 100 << 20
"""Maximum sizes of a JSON file and a file of JSON lines."""

INFLATED_BYTES, RATIO = 200 << 20, 8
"""Maximum size of all arrays in an archive: the larger of a size and a multiple of the file's."""


# --- whole files

TEMPORARY_SUFFIX = ".partial"
"""Suffix of temporary files; a killed process leaves them behind."""


def replace_file(path: Path, data: bytes, mode: int = 0o666) -> None:
    """Write a file atomically: a reader sees the old file or the complete new file.

    Raises OSError if writing fails, for example on a full disk, with the path as `filename`. The
    old file is then unchanged, and no temporary file remains.
    """
    with replacing(path, mode) as partial:
        partial.write_bytes(data)


@contextmanager
def replacing(path: Path, mode: int = 0o666) -> Iterator[Path]:
    """Yield a new, empty file, which then replaces `path`. Raises as `replace_file`.

    A link at `path` is replaced, not followed. `mode` are the permissions before the umask.
    """
    partial = path.with_name(f"{path.name}.{secrets.token_hex(8)}{TEMPORARY_SUFFIX}")
    try:
        with naming(path):
            partial.touch(mode, exist_ok=False)  # O_EXCL does not follow links
            yield partial
            sync(partial)
            partial.replace(path)
            sync_folder(path.parent)
    except BaseException:
        with suppress(OSError):
            partial.unlink()
        raise


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add a file name to system errors without one, such as errors of writes."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def sync(path: Path) -> None:
    """Sync a file to the disk. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(path: Path) -> None:
    """Sync a folder's entries to the disk, if the file system supports it."""
    with suppress(OSError):
        sync(path)


def open_to_append(path: Path, mode: int = 0o666) -> IO[bytes]:
    """Open a file at its end; create it with a mode (before the umask) if missing.

    Raises UsageError for a symbolic link, a file with several hard links, or no regular file.
    """
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, mode)
        found = os.fstat(descriptor)
        if stat.S_ISREG(found.st_mode) and found.st_nlink <= 1:
            return os.fdopen(descriptor, "a+b")
        os.close(descriptor)
    except OSError as error:
        if error.errno not in (errno.EISDIR, errno.ELOOP, errno.ENXIO):
            raise
    raise UsageError(
        f"{path}: a link, or no regular file; accepted: a regular file without links; delete "
        f"{path.name}, or put a copy of the file in its place"
    )


def subfolder(folder: Path, name: str) -> Path:
    """Return the path of a folder below a folder. Raises UsageError for a link below `folder`."""
    for part in Path(name).parts:
        folder = folder / part
        if folder.is_symlink():
            raise UsageError(
                f"{folder}: a link; accepted: a folder; delete the link, or put a copy of the "
                "folder in its place"
            )
    return folder


def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with its content, if it exists. Raises OSError."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def try_lock(descriptor: int) -> bool:
    """Lock a file or folder; return False if another process has locked it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True  # Some network file systems have no locks: nothing stops a second process.
    return True


def open_regular(path: Path, *, links: bool = True) -> IO[bytes]:
    """Open a regular file to read; a pipe or a device, which may never end, is rejected.

    Without `links`, links that lead out of the file's folder are rejected. Raises UsageError.
    """
    with usage_errors(path):
        # Path.resolve raises RuntimeError for a loop.
        real, folder = map(os.path.realpath, (path, path.parent))
        if not links and not Path(real).is_relative_to(folder):
            raise UsageError(f"{path}: a link out of its folder; accepted: a file; copy it there")
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb")
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise UsageError(f"{path}: accepted: a regular file")
    return file


def read_limited(path: Path, what: str, most: int, *, links: bool = True) -> bytes:
    """Return the content of a file of at most `most` bytes; `what` is its name in messages.

    For `links` and errors see `open_regular`.
    """
    with open_regular(path, links=links) as file, usage_errors(path):
        data = file.read(most + 1)
    if len(data) > most:
        raise UsageError(f"{path}: accepted: {what} of at most {most:,} bytes")
    return data


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal. Raises OSError, or UsageError for a pipe."""
    with open_regular(path) as file:
        digest = hashlib.sha256()
        while block := file.read(1 << 20):
            digest.update(block)
        return digest.hexdigest()


@contextmanager
def scratch_folder(prefix: str) -> Iterator[Path]:
    """Yield a new folder for temporary files, and remove those that killed processes left."""
    for left in Path(tempfile.gettempdir()).glob(f"{prefix}*"):
        with suppress(OSError), _opened_folder(left) as descriptor:
            if os.fstat(descriptor).st_uid == os.getuid():
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # Fails if in use.
                shutil.rmtree(left)
    new = Path(tempfile.mkdtemp(prefix=f"new-{prefix}"))
    with _opened_folder(new) as descriptor:
        try_lock(descriptor)
        # Others see the folder under this name only, when it is locked.
        folder = new.rename(new.with_name(new.name.removeprefix("new-")))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _opened_folder(path: Path) -> Iterator[int]:
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


# --- JSON


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a readable JSON file with its CRC. Raises ValueError for a NaN."""
    text = json.dumps(_sealed(data), indent=2, ensure_ascii=False) + "\n"
    replace_file(path, text.encode())


def read_json(path: Path, schema: int | None, what: str) -> dict[str, Any]:
    """Return the object in a JSON file, without its CRC.

    `schema` is the accepted value of its field `schema`, None = no such field; `what` describes the
    folder's content in messages. Raises UsageError if the file is missing, not JSON, damaged, or of
    another version.
    """
    if not path.exists():
        raise UsageError(f"{path.parent}: no {what} here: {path.name}: {os.strerror(errno.ENOENT)}")
    data = read_limited(path, what, JSON_BYTES, links=False)
    try:
        return _opened(data, schema)
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from None


def read_typed(path: Path, adapter: TypeAdapter[T], schema: int | None, what: str) -> T:
    """Return a file's content as a typed object. Raises UsageError, also for a wrong field."""
    return typed(adapter, read_json(path, schema, what), path)


def typed(adapter: TypeAdapter[T], data: Mapping[str, Any], source: object) -> T:
    """Return data as a typed object. Raises UsageError, with the source, for a wrong field."""
    try:
        return adapter.validate_python(data)
    except ValidationError as error:
        raise UsageError(f"{source}: {field_error(error).line(sign=' = ')}") from None


def append_lines(path: Path, objects: Iterable[Mapping[str, Any]]) -> None:
    """Append objects to a file of JSON lines, and sync it to the disk.

    Raises:
        ValueError: A NaN or an infinity.
        OSError: Writing failed; the file is unchanged.
        UsageError: See `open_to_append`.
    """
    data = b"".join(json_line(each) for each in objects)
    with naming(path), open_to_append(path) as file:
        _append(file, data)


def _append(file: IO[bytes], data: bytes) -> None:
    """Append bytes to a file and sync it, or leave it unchanged. Raises OSError."""
    before = file.seek(0, os.SEEK_END)
    view = memoryview(data)
    try:
        # Unbuffered: a failed write must not be repeated when the file is closed.
        while view:
            view = view[os.write(file.fileno(), view) :]
        os.fsync(file.fileno())
    except OSError:
        with suppress(OSError):
            os.ftruncate(file.fileno(), before)
        raise


def json_line(data: Mapping[str, Any]) -> bytes:
    """Return an object as one line with its CRC and newline. Raises ValueError for a NaN."""
    return _compact(_sealed(data)) + b"\n"


def read_lines(path: Path, schema: int | None) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the objects of a file of JSON lines, each with its location: "path:number".

    A last line without a newline was cut short by a kill and is ignored. A missing file has no
    lines. For `schema` and errors see `read_json`.
    """
    if not os.path.lexists(path):
        return
    data = read_limited(path, "lines", LINES_BYTES, links=False)
    number, rest = 1, b""
    for number, line in enumerate(io.BytesIO(data), start=1):
        if not line.endswith(b"\n"):
            rest = line
            break
        try:
            found = _opened(line, schema)
        except ValueError as error:
            raise UsageError(f"{path}:{number}: {error}") from None
        yield f"{path}:{number}", found
    # A kill leaves only the beginning of a line. A complete line with another byte in place of its
    # newline was damaged later.
    with suppress(ValueError, RecursionError):
        if isinstance(json.loads(rest[:-1]), dict):
            raise UsageError(f"{path}:{number}: damaged: no newline at its end")


def cut_torn_line(path: Path) -> None:
    """Remove a last line without a newline. Raises UsageError as `open_to_append`."""
    if os.path.lexists(path):
        with open_to_append(path) as file:
            data = path.read_bytes()
            if (whole := data.rfind(b"\n") + 1) != len(data):
                file.truncate(whole)


def _compact(data: Mapping[str, Any]) -> bytes:
    return json.dumps(data, allow_nan=False, separators=(",", ":")).encode()


def _sealed(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return an object with its CRC as the last field."""
    return {**data, CRC: f"{zlib.crc32(_compact(data)):08x}"}


def _opened(data: bytes, schema: int | None) -> dict[str, Any]:
    """Return the object in JSON bytes, without its CRC. Raises ValueError with one line."""
    try:
        found = json.loads(data, parse_constant=_refuse_constant)
        too_deep = deeper_than(found, DEEPEST)
    except RecursionError:
        too_deep = True
    except ValueError as error:
        raise ValueError(f"not JSON: {error}") from None
    if too_deep:
        raise ValueError(f"nested too deep: accepted: {DEEPEST} levels")
    held = found.get("schema") if isinstance(found, dict) else None
    if not isinstance(found, dict) or (schema is not None and held != schema):
        raise ValueError(f"schema = {held!r}: accepted: {schema}")
    crc = found.pop(CRC, None)
    if crc is not None and crc != (computed := f"{zlib.crc32(_compact(found)):08x}"):
        raise ValueError(
            f"damaged: {CRC} = {crc!r}: accepted: {computed!r}, that of what it holds "
            "(without this field it is read unchecked)"
        )
    return found


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")


def deeper_than(value: object, most: int) -> bool:
    """Return True if lists and tables are nested in more than `most` levels."""
    level = [value]
    for _ in range(most + 1):
        level = [
            inner
            for each in level
            if isinstance(each, dict | list)
            for inner in (each.values() if isinstance(each, dict) else each)
            if isinstance(inner, dict | list)
        ]
        if not level:
            return False
    return True


# --- arrays


class ArrayGroup(NamedTuple):
    """Group of arrays in an archive."""

    arrays: Arrays
    crc32: str
    """CRC-32 of the names and contents of all arrays, hexadecimal."""


NO_ARRAYS = ArrayGroup({}, "00000000")
"""Placeholder for a group missing from an archive."""


def save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays by name to a new .npz, replacing an old file."""
    keywords: dict[str, Any] = dict(arrays)
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, **keywords)


def add_arrays(path: Path, groups: Mapping[str, Mapping[str, NDArray[Any]]]) -> dict[str, str]:
    """Append groups of arrays to an .npz, created if missing; return the CRC of each group.

    Keys become `<group>/<name>`. Only the new arrays are written: `read_groups` needs no directory,
    other programs need the one of `close_archive`. Raises as `append_lines`.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as new:
        for group, arrays in groups.items():
            for name, array in arrays.items():
                with new.open(f"{group}/{name}.npy", "w") as stream:
                    np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
        # The end of the block adds the directory.
        entries, members = buffer.getvalue(), new.infolist()
    with naming(path), open_to_append(path) as file:
        file.seek(max(0, file.tell() - _END_SIZE))
        if file.read(len(_END)) == _END:
            file.seek(0)
            file.truncate(_archive(file.read()).start_dir)
        _append(file, entries)
    return {group: _group_crc([m for m in members if _group_of(m) == group]) for group in groups}


def close_archive(path: Path, groups: Collection[str]) -> None:
    """Remove all but some groups, and an array cut short; write the directory."""
    with naming(path), open_to_append(path) as file:
        file.seek(0)
        data, whole = file.read(), io.BytesIO()
        with _archive(data, groups, whole) as archive:
            entries = archive.start_dir
        if not data.startswith(whole.getbuffer()[:entries]):
            replace_file(path, whole.getvalue())
        elif data != whole.getvalue():
            file.truncate(entries)
            _append(file, whole.getvalue()[entries:])


def read_groups(path: Path, groups: Collection[str]) -> dict[str, ArrayGroup]:
    """Return groups of arrays in an archive, empty without a file. Raises UsageError.

    An archive without its directory, or with an array cut short by a kill, is read as well.
    """
    if not os.path.lexists(path):
        return {}
    try:
        with open_regular(path, links=False) as file, _archive(file.read(), groups) as archive:
            check_inflated(archive)
            found = {}
            for group, members in groupby(archive.infolist(), _group_of):
                held = list(members)
                arrays = {_array_name(each): _read_array(archive, each) for each in held}
                found[group] = ArrayGroup(arrays, _group_crc(held))
            return found
    except UsageError:
        raise
    except Exception as error:  # Bit errors may request passwords or unknown methods.
        raise UsageError(f"{path}: damaged: {' '.join(str(error).split())[:200]}") from None


_HEAD, _ZIP64 = struct.Struct("<4s2xHH4xLLLHH"), struct.Struct("<4xQQ")
"""Head of a member: signature, flags, method, CRC, packed size, size, lengths of name and extra
field; extra field for sizes above 4 GB, which NumPy always writes."""

_END, _END_SIZE = b"PK\5\6", 22
"""Signature and size of the record after the directory."""


def check_inflated(archive: zipfile.ZipFile) -> None:
    """Raise ValueError for an archive with much more data than its file has bytes."""
    total = sum(member.file_size for member in archive.infolist())
    if total > (most := max(INFLATED_BYTES, RATIO * archive.start_dir)):
        raise ValueError(f"{total:,} bytes of arrays; accepted: at most {most:,}")


def _archive(
    data: bytes, groups: Collection[str] | None = None, whole: io.BytesIO | None = None
) -> zipfile.ZipFile:
    """Copy the complete members of groups, None = all, by their heads, into an open archive."""
    whole, start = whole or io.BytesIO(), 0
    archive = zipfile.ZipFile(whole, "w")
    while len(data) - start >= _HEAD.size:
        signature, flags, method, crc, packed, size, *lengths = _HEAD.unpack_from(data, start)
        name = start + _HEAD.size
        extra = name + lengths[0]
        if packed == 0xFFFF_FFFF and lengths[1] >= _ZIP64.size <= len(data) - extra:
            size, packed = _ZIP64.unpack_from(data, extra)
        end = extra + lengths[1] + packed
        # A directory, or an array that a kill cut short.
        if signature != b"PK\3\4" or end > len(data):
            break
        member = zipfile.ZipInfo(data[name:extra].decode(errors="replace"))
        member.flag_bits, member.compress_type, member.CRC = flags, method, crc
        member.compress_size, member.file_size = packed, size
        member.header_offset, member.external_attr = whole.tell(), 0o600 << 16
        if groups is None or _group_of(member) in groups:
            whole.write(data[start:end])
            archive.filelist.append(member)
        start = end
    archive.start_dir = whole.tell()
    return archive


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """Return an array. The member is read completely first, which checks its CRC."""
    data = io.BytesIO(archive.read(member))
    array: NDArray[Any] = np.lib.format.read_array(data, allow_pickle=False)
    return array


def _group_crc(members: Sequence[zipfile.ZipInfo]) -> str:
    """Return a CRC over the names and the CRCs of an archive's members."""
    lines = sorted(f"{member.filename} {member.CRC:08x}\n" for member in members)
    return f"{zlib.crc32(''.join(lines).encode()):08x}"


def _group_of(member: zipfile.ZipInfo) -> str:
    return member.filename.partition("/")[0]


def _array_name(member: zipfile.ZipInfo) -> str:
    return member.filename.partition("/")[2].removesuffix(".npy")


# --- logs

PARTIAL_SUFFIX = ".part"
"""Suffix of the file's name until the log is complete."""

_FLUSH_BYTES = 65_536
_FLUSH_US = US_PER_S


class LogFile:
    """Writer of complete records, at the latest after one second of simulated time.

    A killed process leaves a valid log under the temporary name, which lacks at most its last
    second. If writing fails, for example on a full disk, the log ends with its last complete
    record. The program continues without it.
    """

    def __init__(self, path: Path, on_lost: Callable[[str], None] = lambda _: None) -> None:
        """Open the file, or raise OSError. `on_lost` is called once if writing fails."""
        self.path = path
        self.on_lost = on_lost
        self.lost = False
        """True if the log has ended early."""
        self.failure: OSError | None = None
        self.partial_path = path.with_name(path.name + PARTIAL_SUFFIX)
        self._buffer = bytearray()
        self._written = 0
        self._flushed_us: int | None = None
        self.partial_path.unlink(missing_ok=True)
        # O_EXCL does not follow links.
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
        self._file = os.fdopen(os.open(self.partial_path, flags, 0o600), "wb", buffering=0)

    @property
    def size_bytes(self) -> int:
        """Current size, including buffered data [bytes]."""
        return self._written + len(self._buffer)

    @property
    def written_bytes(self) -> int:
        """Current size of the file [bytes]."""
        return self._written

    @property
    def closed(self) -> bool:
        """True if the log is complete."""
        return self._file.closed

    def add(self, time_us: int, *parts: bytes) -> None:
        """Add one record, in parts, at simulated `time_us` [µs]."""
        if self.lost:
            return
        for part in parts:
            self._buffer += part
        if self._flushed_us is None:
            self._flushed_us = time_us
        if len(self._buffer) >= _FLUSH_BYTES or time_us - self._flushed_us >= _FLUSH_US:
            self.flush()
            self._flushed_us = time_us

    def flush(self) -> None:
        """Write buffered data to the file."""
        whole = self._written
        view = memoryview(bytes(self._buffer))
        self._buffer.clear()
        try:
            while view:
                count = self._file.write(view)
                self._written += count
                view = view[count:]
        except OSError as error:
            self._end(error, whole)

    def close(self) -> None:
        """Complete the log and rename it to its final name; may be called repeatedly.

        A lost log without records is deleted.
        """
        if self._file.closed:
            return
        self.flush()
        try:
            self._file.close()
            if self.lost and not self._written:
                self.partial_path.unlink()
            else:
                self.partial_path.replace(self.path)
        except OSError as error:
            self._end(error, self._written)

    def discard(self) -> None:
        """Close and delete the file."""
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):
            self.partial_path.unlink()

    def _end(self, error: OSError, whole: int) -> None:
        """Stop writing, and truncate the file to its complete records of `whole` bytes."""
        with suppress(OSError, ValueError):  # not a regular file, or closed
            self._file.truncate(whole)
        self._written = whole
        if not self.lost:
            self.lost, self.failure = True, error
            self.on_lost(f"{self.path}: {error.strerror}; the log ends after {whole} bytes")
