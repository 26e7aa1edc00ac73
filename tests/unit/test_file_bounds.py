"""Files at their bounds: sizes, modes, nesting, links, locks and open descriptors."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import socket
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from airl_mav.core import files
from airl_mav.core.errors import UsageError
from airl_mav.core.files import LogFile
from tests.support.full_disk import largest_file

REFUSED = "a link, or no regular file"


@pytest.fixture(autouse=True)
def descriptors() -> Iterator[Callable[[], set[Path]]]:
    """Yield a function that lists the open descriptors; the test must not leave any."""

    def opened() -> set[Path]:
        return set(Path("/proc/self/fd").iterdir())

    before = opened()
    yield opened
    assert opened() <= before


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the paths that are synced to the disk from now on."""
    paths: list[str] = []
    sync = os.fsync

    def noted(descriptor: int) -> None:
        sync(descriptor)
        paths.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)

    monkeypatch.setattr(os, "fsync", noted)
    return paths


@pytest.fixture
def umask() -> Iterator[None]:
    before = os.umask(0o027)
    yield
    os.umask(before)


# --- whole files


@pytest.mark.usefixtures("umask")
def test_a_new_file_has_its_mode_and_is_synced_with_its_folder(
    tmp_path: Path, synced: list[str]
) -> None:
    path = tmp_path / "x"
    files.replace_file(path, b"new")
    assert path.read_bytes() == b"new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert synced[0].startswith("x.")
    assert synced[0].endswith(files.TEMPORARY_SUFFIX)
    assert synced[1:] == [tmp_path.name]
    files.replace_file(path, b"key", 0o600)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with files.open_to_append(tmp_path / "log", 0o604) as file:
        assert stat.S_IMODE(os.fstat(file.fileno()).st_mode) == 0o600


def test_a_failed_write_names_its_file_and_its_temporary_file_may_be_gone(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="full") as caught, files.replacing(tmp_path / "x") as partial:
        partial.unlink()
        raise OSError(28, "full")
    assert (caught.value.errno, caught.value.filename) == (28, str(tmp_path / "x"))
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_opened_at_its_end_to_read_and_append(tmp_path: Path) -> None:
    path = tmp_path / "x"
    for part in (b"one", b"two"):
        with files.open_to_append(path) as file:
            file.write(part)
    with files.open_to_append(path) as file:
        assert file.tell() == 6
        file.seek(0)
        assert file.read() == b"onetwo"
        os.write(file.fileno(), b"!")
    assert path.read_bytes() == b"onetwo!"


def a_fifo(path: Path) -> None:
    os.mkfifo(path)


def a_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        # A path of a socket has at most 107 bytes.
        here = Path.cwd()
        os.chdir(path.parent)
        try:
            server.bind(path.name)
        finally:
            os.chdir(here)


def a_hard_link(path: Path) -> None:
    (path.parent / "other").write_bytes(b"theirs")
    path.hardlink_to(path.parent / "other")


def a_link_to_nothing(path: Path) -> None:
    path.symlink_to("nothing")


@pytest.mark.parametrize("make", [a_fifo, a_socket, a_hard_link, a_link_to_nothing, Path.mkdir])
def test_only_a_regular_file_without_links_is_appended_to(
    tmp_path: Path, make: Callable[[Path], None], descriptors: Callable[[], set[Path]]
) -> None:
    path = tmp_path / "x"
    make(path)
    before = descriptors()
    with pytest.raises(UsageError, match=REFUSED) as caught:
        files.open_to_append(path)
    assert descriptors() <= before
    assert str(caught.value).startswith(f"{path}: ")
    assert "delete x" in str(caught.value)


def test_other_errors_of_opening_stay_system_errors(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(NotADirectoryError):
        files.open_to_append(tmp_path / "file" / "x")
    with pytest.raises(FileNotFoundError):
        files.open_to_append(tmp_path / "none" / "x")


def test_no_link_below_a_folder_is_followed(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b").symlink_to(tmp_path)
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "a")
    assert files.subfolder(link, "c/d") == link / "c" / "d", "the folder itself may be a link"
    with pytest.raises(UsageError, match=r"/a/b: a link; accepted: a folder"):
        files.subfolder(tmp_path, "a/b/c")


def test_files_links_and_folders_are_removed(tmp_path: Path) -> None:
    folder, link, file = (tmp_path / name for name in ("folder", "link", "file"))
    (folder / "inner").mkdir(parents=True)
    file.write_bytes(b"x")
    link.symlink_to(folder)
    for path in (link, file, tmp_path / "none"):
        files.remove(path)
        assert not os.path.lexists(path)
    assert (folder / "inner").is_dir()
    files.remove(folder)
    assert not folder.exists()


def test_only_regular_files_are_read(tmp_path: Path, descriptors: Callable[[], set[Path]]) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    before = descriptors()
    with pytest.raises(UsageError, match="pipe: accepted: a regular file") as caught:
        files.open_regular(path)
    assert descriptors() <= before
    del caught
    with pytest.raises(UsageError, match="none"):
        files.open_regular(tmp_path / "none")


def test_links_out_of_the_folder_are_read_on_request(tmp_path: Path) -> None:
    inside, folder = tmp_path / "in", tmp_path / "in" / "x"
    inside.mkdir()
    (tmp_path / "out").write_bytes(b"out")
    (inside / "near").write_bytes(b"near")
    folder.symlink_to("near")
    assert files.read_limited(folder, "x", 4, links=False) == b"near"
    folder.unlink()
    folder.symlink_to("../out")
    assert files.read_limited(folder, "x", 3) == b"out"
    with pytest.raises(UsageError, match="x: a link out of its folder"):
        files.read_limited(folder, "x", 3, links=False)
    folder.unlink()
    folder.symlink_to("x")
    with pytest.raises(UsageError, match="x: "):
        files.read_limited(folder, "x", 3)


def test_a_file_has_at_most_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(bytes(1234))
    assert files.read_limited(path, "thing", 1234) == bytes(1234)
    with pytest.raises(UsageError, match=r"x: accepted: thing of at most 1,233 bytes"):
        files.read_limited(path, "thing", 1233)


def test_the_digest_covers_the_whole_file(tmp_path: Path) -> None:
    path, data = tmp_path / "x", np.random.default_rng(0).bytes(2_500_000)
    path.write_bytes(data)
    assert files.sha256_of(path) == hashlib.sha256(data).hexdigest()


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_scratch_folder_is_new_and_is_removed(scratch: Path) -> None:
    with files.scratch_folder("mine-") as one, files.scratch_folder("mine-") as two:
        assert one.parent == two.parent == scratch
        assert one.is_dir(), "in use: the second one leaves it"
        assert one.name.startswith("mine-")
        assert two != one
        (two / "file").write_bytes(b"x")
    assert list(scratch.iterdir()) == []
    with pytest.raises(ValueError, match="mine"), files.scratch_folder("mine-") as one:
        shutil.rmtree(one)
        raise ValueError("mine")


def test_folders_that_killed_processes_left_are_removed(
    scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("mine-left", "theirs-left"):
        (scratch / name).mkdir()
        (scratch / name / "file").write_bytes(b"x")
    (scratch / "mine-file").write_bytes(b"x")
    os.mkfifo(scratch / "mine-pipe")  # to open it could last forever
    (scratch / "mine-link").symlink_to(scratch / "theirs-left")
    with monkeypatch.context() as patch:
        patch.setattr(os, "getuid", lambda: scratch.stat().st_uid + 1)
        with files.scratch_folder("mine-"):
            assert (scratch / "mine-left").exists(), "of another user"
    with files.scratch_folder("mine-"):
        assert not (scratch / "mine-left").exists()
    assert (scratch / "theirs-left" / "file").exists()
    assert (scratch / "mine-file").exists()
    assert (scratch / "mine-pipe").exists()
    assert (scratch / "mine-link").is_symlink()


# --- JSON


def test_a_json_file_is_readable_text(tmp_path: Path) -> None:
    path = tmp_path / "x"
    files.write_json(path, {"a": "ü", "b": [1]})
    crc = zlib.crc32(rb'{"a":"\u00fc","b":[1]}')
    text = '{\n  "a": "ü",\n  "b": [\n    1\n  ],\n  "crc32": "%08x"\n}\n'
    assert path.read_text("utf-8") == text % crc
    with pytest.raises(ValueError, match="JSON compliant"):
        files.write_json(path, {"a": float("nan")})
    assert files.json_line({"a": 1}) == b'{"a":1,"crc32":"%08x"}\n' % zlib.crc32(b'{"a":1}')
    with pytest.raises(ValueError, match="JSON compliant"):
        files.json_line({"a": float("inf")})


def test_a_json_file_has_a_bound_and_no_link_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run" / "x"
    path.parent.mkdir()
    with pytest.raises(UsageError, match=r"/run: no thing here: x: No such file"):
        files.read_json(path, None, "thing")
    path.write_text('{"schema": 3}', "ascii")
    assert files.read_json(path, None, "thing") == {"schema": 3}
    monkeypatch.setattr(files, "JSON_BYTES", 12)
    with pytest.raises(UsageError, match="thing of at most 12 bytes"):
        files.read_json(path, None, "thing")
    monkeypatch.undo()
    path.rename(tmp_path / "x")
    path.symlink_to(tmp_path / "x")
    with pytest.raises(UsageError, match="a link out"):
        files.read_json(path, None, "thing")


@pytest.mark.parametrize("shape", ["[%s]", '{"a":%s}', '[1,{"a":2,"b":%s},[]]'])
def test_nesting_is_counted_in_levels_below_the_first(shape: str) -> None:
    per, text, depth = shape.count("%s") + shape.startswith("[1"), "[]", 1
    while depth < 40:
        found = json.loads(text)
        assert depth == 1 or files.deeper_than(found, depth - 2)
        assert not files.deeper_than(found, depth - 1)
        text, depth = shape % text, depth + per
    assert not files.deeper_than("text", 0)


def test_a_json_file_may_have_a_hundred_nested_levels(tmp_path: Path) -> None:
    path = tmp_path / "x"
    for depth in (101, 102):
        path.write_text('{"a":' * depth + "1" + "}" * depth, "ascii")
        if depth == 101:
            assert files.read_json(path, None, "thing")
    with pytest.raises(UsageError, match="nested too deep: accepted: 100 levels"):
        files.read_json(path, None, "thing")


def test_lines_are_appended_and_synced_or_not_at_all(tmp_path: Path, synced: list[str]) -> None:
    path = tmp_path / "x"
    files.append_lines(path, [{"a": 1}, {"a": 2}])
    files.append_lines(path, [{"a": 3}])
    assert synced == ["x", "x"]
    before = path.read_bytes()
    assert [found for _, found in files.read_lines(path, None)] == [{"a": n} for n in (1, 2, 3)]
    with largest_file(len(before) + 5), pytest.raises(OSError, match="too large") as caught:
        files.append_lines(path, [{"a": 4}])
    assert caught.value.filename == str(path)
    assert path.read_bytes() == before


def lines_of(path: Path, data: bytes, schema: int | None = None) -> list[tuple[str, Any]]:
    path.write_bytes(data)
    return list(files.read_lines(path, schema))


def test_lines_are_numbered_from_one(tmp_path: Path) -> None:
    path = tmp_path / "x"
    assert list(files.read_lines(path, None)) == []
    assert lines_of(path, b"") == []
    assert lines_of(path, b'{"a":1}\n{"b":2}\n') == [
        (f"{path}:1", {"a": 1}),
        (f"{path}:2", {"b": 2}),
    ]
    with pytest.raises(UsageError, match=r"x:2: schema = None: accepted: 1"):
        lines_of(path, b'{"schema":1}\n{"b":2}\n', 1)
    with pytest.raises(UsageError, match=r"x:1: not JSON"):
        lines_of(path, b'{"a":\n{"b":2}\n')


@pytest.mark.parametrize("rest", [b'{"b":2', b"{", b'{"b":2}', b"[1]?", b"[" * 100_000, b"\xff?"])
def test_a_line_without_its_end_is_ignored(tmp_path: Path, rest: bytes) -> None:
    path = tmp_path / "x"
    assert lines_of(path, b'{"a":1}\n' + rest) == [(f"{path}:1", {"a": 1})]
    assert lines_of(path, rest) == []


def test_another_byte_in_place_of_the_last_newline_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "x"
    with pytest.raises(UsageError, match=r"x:2: damaged: no newline at its end"):
        lines_of(path, b'{"a":1}\n{"b":2}?')
    with pytest.raises(UsageError, match=r"x:1: damaged: no newline at its end"):
        lines_of(path, b'{"b":2}?')


def test_files_of_lines_have_a_bound_and_no_link_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run" / "x"
    path.parent.mkdir()
    assert lines_of(path, b'{"a":1}\n')
    with monkeypatch.context() as patch, pytest.raises(UsageError, match="at most 7 bytes"):
        patch.setattr(files, "LINES_BYTES", 7)
        list(files.read_lines(path, None))
    path.rename(tmp_path / "x")
    path.symlink_to(tmp_path / "x")
    with pytest.raises(UsageError, match="a link out"):
        list(files.read_lines(path, None))


@pytest.mark.parametrize(
    ("data", "kept"), [(b"", b""), (b"a\n", b"a\n"), (b"a\nb", b"a\n"), (b"ab", b"")]
)
def test_a_torn_line_is_cut(tmp_path: Path, data: bytes, kept: bytes) -> None:
    path = tmp_path / "x"
    files.cut_torn_line(path)
    assert not path.exists()
    path.write_bytes(data)
    files.cut_torn_line(path)
    assert path.read_bytes() == kept
    (tmp_path / "link").symlink_to(path)
    with pytest.raises(UsageError, match=REFUSED):
        files.cut_torn_line(tmp_path / "link")


# --- arrays


def test_an_archive_without_arrays_is_added_to(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    for before in (b"", b"PK\5\6" + bytes(18)):
        path.write_bytes(before)
        files.add_arrays(path, {"0": {"a": np.arange(3)}})
        assert path.read_bytes().startswith(b"PK\3\4"), "no directory in front"
        assert files.read_groups(path, {"0"})["0"].arrays["a"].tolist() == [0, 1, 2]
        path.unlink()


def test_the_checksum_of_a_group_is_that_of_its_names_and_members(tmp_path: Path) -> None:
    path, arrays = tmp_path / "x.npz", {"b": np.arange(3), "a/c": np.ones(2)}
    crcs = files.add_arrays(path, {"0": arrays, "1": {"b": np.arange(4)}})
    found = files.read_groups(path, {"0", "1", "2"})
    assert {group: each.crc32 for group, each in found.items()} == crcs
    lines = []
    for name, array in arrays.items():
        stream = io.BytesIO()
        np.save(stream, array)
        lines.append(f"0/{name}.npy {zlib.crc32(stream.getvalue()):08x}\n")
    assert crcs["0"] == f"{zlib.crc32(''.join(sorted(lines)).encode()):08x}"
    assert list(found["0"].arrays) == ["b", "a/c"]
    assert list(files.read_groups(path, {"1"})) == ["1"]
    assert files.read_groups(tmp_path / "none.npz", {"0"}) == {}


def test_arrays_are_packed_at_the_fastest_level(tmp_path: Path) -> None:
    array = np.cumsum(np.random.default_rng(0).integers(0, 9, 5000))
    files.add_arrays(tmp_path / "x.npz", {"0": {"a": array}})
    deflate = [zlib.compressobj(level, zlib.DEFLATED, -15) for level in (1, 2)]
    one, two = (each.compress(npy(array)) + each.flush() for each in deflate)
    assert one != two
    assert one in (tmp_path / "x.npz").read_bytes()


def test_archives_are_read_inside_of_their_folder_alone(tmp_path: Path) -> None:
    path = tmp_path / "run" / "x.npz"
    path.parent.mkdir()
    files.save_arrays(tmp_path / "x.npz", {"0/a": np.arange(3)})
    path.symlink_to(tmp_path / "x.npz")
    with pytest.raises(UsageError, match="a link out"):
        files.read_groups(path, {"0"})
    path.unlink()
    path.symlink_to("nothing")
    with pytest.raises(UsageError, match=r"x\.npz"):
        files.read_groups(path, {"0"})


def test_an_array_of_objects_is_damage_in_one_short_line(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    files.save_arrays(path, {"0/a": np.array([object()])})
    with pytest.raises(UsageError, match=r"x\.npz: damaged: Object arrays cannot be loaded"):
        files.read_groups(path, {"0"})
    header = b"[" + b"1,\n" * 300 + b"]"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("0/a.npy", b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(UsageError) as caught:
        files.read_groups(path, {"0"})
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) == len(f"{path}: damaged: ") + 200


@pytest.mark.parametrize(("packed", "most"), [(0, 200 << 20), (26 << 20, 208 << 20)])
def test_arrays_may_be_eight_times_the_file_or_200_mebibytes(packed: int, most: int) -> None:
    for more in (0, 1):
        with zipfile.ZipFile(io.BytesIO(), "w") as archive:
            for size in (1000, most - 1000 + more):
                archive.filelist.append(zipfile.ZipInfo("a"))
                archive.filelist[-1].file_size = size
            archive.start_dir = packed
            try:
                files.check_inflated(archive)
                assert not more
            except ValueError as error:
                assert more
                assert str(error) == f"{most + 1:,} bytes of arrays; accepted: at most {most:,}"
            archive.filelist.clear()
            archive.start_dir = 0


def test_an_archive_that_inflates_too_much_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.npz"
    files.add_arrays(path, {"0": {"a": np.zeros(5000)}})
    assert files.read_groups(path, {"0"})["0"].arrays["a"].size == 5000
    monkeypatch.setattr(files, "INFLATED_BYTES", 40_000)
    with pytest.raises(UsageError, match=r"x\.npz: damaged: 40,128 bytes of arrays; accepted"):
        files.read_groups(path, {"0"})


def member(name: bytes, data: bytes, extra: bytes = b"", *, large: bool = False) -> bytes:
    """Return a stored member of an archive by the ZIP specification: head, name, extra, data."""
    size = b"\xff" * 8 if large else len(data).to_bytes(4, "little") * 2
    crc = zlib.crc32(data).to_bytes(4, "little")
    lengths = len(name).to_bytes(2, "little") + len(extra).to_bytes(2, "little")
    return b"PK\3\4\x14\0" + bytes(8) + crc + size + lengths + name + extra + data


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def test_members_are_found_by_their_heads(tmp_path: Path) -> None:
    path, data = tmp_path / "x.npz", npy(np.arange(5))
    sizes = b"\1\0\x10\0" + len(data).to_bytes(8, "little") * 2
    one, two = member(b"0/a.npy", data), member(b"1/b.npy", data, sizes, large=True)
    path.write_bytes(one + two)
    found = files.read_groups(path, {"0", "1"})
    assert [list(each.arrays) for each in found.values()] == [["a"], ["b"]]
    assert found["1"].arrays["b"].tolist() == list(range(5))
    files.close_archive(path, {"1"})
    with zipfile.ZipFile(path) as archive:
        (left,) = archive.infolist()
        assert (left.filename, left.header_offset, left.file_size) == ("1/b.npy", 0, len(data))
        assert left.external_attr >> 16 == 0o600
        assert archive.testzip() is None
    # Cut within the last bytes, within the extra field, and within a head.
    for cut in (1, len(data) + 1, len(data) + len(sizes) + 1, len(two) - 1):
        path.write_bytes(one + two[:-cut])
        assert list(files.read_groups(path, {"0", "1"})) == ["0"]
    for other in (b"PK\3\5", b"abcd"):
        path.write_bytes(one + other + two[4:])
        assert list(files.read_groups(path, {"0", "1"})) == ["0"]
    path.write_bytes(one + two.replace(sizes, bytes(12), 1))
    assert list(files.read_groups(path, {"0"})) == ["0"]


def test_a_head_alone_is_a_member(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    path.write_bytes(member(b"0/a.npy", npy(np.arange(5))) + member(b"", b""))
    files.close_archive(path, {"0", ""})
    with zipfile.ZipFile(path) as archive:
        assert archive.namelist() == ["0/a.npy", ""]


def test_a_name_of_other_bytes_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    path.write_bytes(member(b"0/\xff.npy", npy(np.arange(5))))
    with pytest.raises(UsageError, match=r"x\.npz: damaged: "):
        files.read_groups(path, {"0"})


@pytest.mark.parametrize("place", [6, 8])
def test_encrypted_members_and_unknown_methods_are_damage(tmp_path: Path, place: int) -> None:
    path, data = tmp_path / "x.npz", bytearray(member(b"0/a.npy", npy(np.arange(5))))
    data[place] = 1
    path.write_bytes(data)
    with pytest.raises(UsageError, match=r"x\.npz: damaged: "):
        files.read_groups(path, {"0"})


# --- logs


def test_a_log_is_written_every_second_and_every_64_kibibytes(tmp_path: Path) -> None:
    path = tmp_path / "x"
    log = LogFile(path)
    sizes = []
    for time_us, part in (
        (5_000_000, b"1"),
        (5_999_999, b"23"),
        (6_000_000, b"4"),
        (6_999_999, b"5"),
        (7_000_000, b"6"),
        (7_000_001, bytes(65_535)),
        (7_000_002, b"7"),
        (7_000_003, b"8"),
        (8_000_002, b"9"),
    ):
        log.add(time_us, part)
        assert log.written_bytes == log.partial_path.stat().st_size
        sizes.append((log.size_bytes, log.written_bytes))
    whole = 65_541
    assert sizes == [
        *((1, 0), (3, 0), (4, 4), (5, 4), (6, 6), (whole, 6), (whole + 1, whole + 1)),
        *((whole + 2, whole + 1), (whole + 3, whole + 3)),
    ]
    log.add(8_000_003, b"a", b"b")
    assert not log.closed
    assert not path.exists()
    assert stat.S_IMODE(log.partial_path.stat().st_mode) == 0o600
    log.close()
    assert log.closed
    assert (log.lost, log.failure) == (False, None)
    assert path.read_bytes().endswith(b"789ab")
    path.write_bytes(b"mine")
    log.close()
    assert path.read_bytes() == b"mine"
    assert list(tmp_path.iterdir()) == [path]


def test_a_log_is_new_and_can_be_discarded(tmp_path: Path) -> None:
    path = tmp_path / "x"
    (tmp_path / "x.part").write_bytes(b"old")
    log = LogFile(path)
    assert log.partial_path == tmp_path / "x.part"
    assert log.partial_path.read_bytes() == b""
    log.discard()
    log.discard()
    assert log.closed
    assert list(tmp_path.iterdir()) == []


def test_a_lost_log_ends_after_its_last_whole_record(tmp_path: Path) -> None:
    said: list[str] = []
    path = tmp_path / "x"
    log = LogFile(path, said.append)
    log.add(0, b"1234")
    log.flush()
    with largest_file(6):
        log.add(0, b"5678")
        log.flush()
        assert log.lost
        assert log.failure is not None
        assert log.failure.errno == 27
        log.add(9_000_000, b"more")
    assert (log.size_bytes, log.written_bytes) == (4, 4)
    log.add(99_000_000, b"more")
    log.close()
    assert path.read_bytes() == b"1234"
    assert said == [f"{path}: File too large; the log ends after 4 bytes"]


def test_a_log_that_cannot_be_renamed_is_lost(tmp_path: Path) -> None:
    said: list[str] = []
    path = tmp_path / "x"
    log = LogFile(path, said.append)
    log.add(0, b"1234")
    path.mkdir()
    (path / "file").write_bytes(b"")
    log.close()
    assert log.lost
    assert said == [f"{path}: Is a directory; the log ends after 4 bytes"]
    assert log.partial_path.read_bytes() == b"1234"
