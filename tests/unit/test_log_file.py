"""Log files on a full disk: they end with the last whole record and report this once."""

from __future__ import annotations

from pathlib import Path

import pytest

from airl_mav.core.files import LogFile
from tests.support.full_disk import largest_file

RECORD = b"0123456789abcdef" * 64


def test_a_log_on_a_disk_that_fills_up_keeps_its_whole_records(tmp_path: Path) -> None:
    said: list[str] = []
    path = tmp_path / "flight.tlog"
    log = LogFile(path, said.append)
    with largest_file(100_000):
        for second in range(200):
            log.add(second * 1_000_000, RECORD)
        assert log.lost
        log.close()
    # One record a second is written: the hundredth does not fit, and of it some bytes did.
    whole = 100_000 // len(RECORD) * len(RECORD)
    assert path.read_bytes() == RECORD * (whole // len(RECORD))
    assert said == [f"{path}: File too large; the log ends after {whole} bytes"]
    assert not log.partial_path.exists()
    log.close()


def test_a_log_on_a_full_disk_is_not_there(tmp_path: Path) -> None:
    said: list[str] = []
    path = tmp_path / "flight.ulg"
    log = LogFile(path, said.append)
    with largest_file(0):
        log.add(0, RECORD)
        log.flush()
        log.add(5_000_000, RECORD)
        log.close()
    assert said == [f"{path}: File too large; the log ends after 0 bytes"]
    assert list(tmp_path.iterdir()) == []


def test_a_log_in_no_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        LogFile(tmp_path / "none" / "flight.tlog")
