"""Worker processes: what they do, and what they survive."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from airl_mav.core.errors import UsageError
from airl_mav.rehearsal import workers as workers_module
from airl_mav.rehearsal.workers import ONE_THREAD, WorkerError, Workers
from tests.support import worker_jobs
from tests.support.processes import ROOT, is_running, running, wait_until


def test_every_job_is_done_once_by_no_more_than_so_many() -> None:
    with Workers(worker_jobs.doubles, 2) as workers:
        done = list(workers.do(range(20)))
    assert sorted(double for double, _ in done) == [2 * job for job in range(20)]
    pids = {pid for _, pid in done}
    assert 1 <= len(pids) <= 2
    assert os.getpid() not in pids
    assert not any(is_running(pid) for pid in pids)


def test_each_worker_starts_once_and_no_more_start_than_there_are_jobs(tmp_path: Path) -> None:
    with Workers(partial(worker_jobs.counted, tmp_path), 5) as workers:
        assert sorted(workers.do(range(2))) == [0, 1]
    assert 1 <= len(list(tmp_path.glob("start-*"))) <= 2
    assert len(list(tmp_path.glob("job-*"))) == 2


def test_no_jobs_no_workers() -> None:
    with Workers(partial(worker_jobs.complains, "start"), 2) as workers:
        assert list(workers.do([])) == []


def test_a_slow_job_holds_nobody_up(tmp_path: Path) -> None:
    # Dealt out beforehand, half of the others would wait for the first, and it for them.
    with Workers(partial(worker_jobs.all_but_the_first, tmp_path, 9), 2) as workers:
        done = list(workers.do(range(9)))
    assert done[-1] == 0
    assert sorted(done) == list(range(9))


def test_a_worker_has_one_thread_and_is_deaf_to_ctrl_c() -> None:
    before = dict(os.environ)
    with Workers(worker_jobs.surroundings, 1) as workers:
        (told,) = workers.do([1])
    assert told["threads"] == ONE_THREAD
    assert told["deaf"]
    assert dict(os.environ) == before
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, set())


@pytest.mark.parametrize(
    ("how", "name"), [("kill", "SIGKILL"), ("exit", "exit status 7"), ("half", "exit status 7")]
)
def test_the_job_of_a_lost_worker_is_given_to_another(tmp_path: Path, how: str, name: str) -> None:
    lost: list[str] = []
    start = partial(worker_jobs.dies, tmp_path, 2, how)
    with Workers(start, 2, name=lambda job: f"seed {job}", lost=lost.append) as workers:
        assert sorted(workers.do(range(6))) == list(range(6))
    assert lost == [f"a worker was lost by {name}: seed 3 begins again"] * 2


def test_a_job_that_loses_three_workers_ends_it_all(tmp_path: Path) -> None:
    start = partial(worker_jobs.dies, tmp_path, 3, "kill")
    done = []
    message = r"^seed 3: lost 3 workers, the last one by SIGKILL$"
    with (
        Workers(start, 1, name=lambda job: f"seed {job}") as workers,
        pytest.raises(WorkerError, match=message),
    ):
        for job in workers.do(range(6)):
            done.append(job)
    assert done == [0, 1, 2]
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(
    ("how", "kind", "message"),
    [
        ("usage", UsageError, r"^seed 3: three is too many$"),
        ("broken", WorkerError, r"^seed 3: RuntimeError: three lines of trouble$"),
        ("start", UsageError, r"^seed 0: nothing to start with$"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(
    how: str, kind: type[Exception], message: str
) -> None:
    start = partial(worker_jobs.complains, how)
    with (
        Workers(start, 1, name=lambda job: f"seed {job}") as workers,
        pytest.raises(kind, match=message),
    ):
        list(workers.do(range(6)))


def test_whoever_stops_does_not_wait_for_what_is_under_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers_module, "END_S", 3600.0)

    def both_sleep() -> bool:
        return len(list(tmp_path.glob("pid-*"))) == 2

    with Workers(partial(worker_jobs.sleeps, tmp_path), 2) as workers:
        assert sorted(workers.do(range(4), both_sleep)) == [0, 1]
    for path in tmp_path.glob("pid-*"):
        assert not is_running(int(path.read_text()))


def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    jobs = tmp_path / "jobs"
    jobs.mkdir()
    words = ["-m", "worker_jobs", str(jobs)]
    with running(words, tmp_path, path=Path(f"{ROOT}{os.pathsep}{ROOT / 'tests'}")) as parent:
        wait_until(lambda: len(list(jobs.glob("pid-*"))) == 2, "two jobs that never end")
        pids = [int(path.read_text()) for path in jobs.glob("pid-*")]
        assert all(is_running(pid) for pid in pids)
        parent.process.send_signal(signal.SIGKILL)
        for pid in pids:
            wait_until(lambda pid=pid: not is_running(pid), "an orphan to end", 30.0)
        # Nothing but what it was: no trace of a worker that was surprised.
        assert parent.text() == ""
