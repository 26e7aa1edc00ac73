"""Executors: execution of jobs, and recovery from failures."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import psutil
import pytest

from airl_mav.core.errors import UsageError
from airl_mav.core.machine import package_versions
from airl_mav.experiments import executors
from airl_mav.experiments.executors import (
    ONE_THREAD,
    Executor,
    ExecutorSettings,
    InProcessExecutor,
    ProcessExecutor,
    WorkerError,
    open_executor,
)
from tests.support import worker_jobs
from tests.support.processes import ROOT, has_ended, is_running, running, wait_until

NEEDS_RAY = pytest.mark.skipif(find_spec("ray") is None, reason="not installed: airl-mav[ray]")


def seed(job: int) -> str:
    return f"seed {job}"


@pytest.fixture(scope="module")
def ray_executor() -> Iterator[Executor]:
    settings = ExecutorSettings(executor="ray", workers=2)
    with pytest.MonkeyPatch.context() as patch:
        # For its workers, which import the jobs of this test.
        patch.setenv("PYTHONPATH", f"{ROOT}")
        with open_executor(settings) as executor:
            yield executor


@pytest.fixture(
    params=[
        "in-process",
        "process",
        pytest.param("ray", marks=[NEEDS_RAY, pytest.mark.slow, pytest.mark.xdist_group("ray")]),
    ]
)
def executor(request: pytest.FixtureRequest) -> Iterator[Executor]:
    if request.param == "ray":
        found: Executor = request.getfixturevalue("ray_executor")
        yield found
    elif request.param == "in-process":
        yield InProcessExecutor()
    else:
        with ProcessExecutor(2) as processes:
            yield processes


# --- all executors


def test_every_job_gives_all_its_results_once(executor: Executor) -> None:
    done = list(executor.run(range(20), worker_jobs.pairs))
    assert sorted(done) == sorted((job, sign * job) for job in range(20) for sign in (1, -1))


def test_no_jobs_start_nothing(executor: Executor) -> None:
    assert list(executor.run([], partial(worker_jobs.complains, "start"))) == []


def test_jobs_are_taken_when_somebody_is_free(executor: Executor) -> None:
    taken = []

    def jobs() -> Iterator[int]:
        for job in range(20):
            taken.append(job)
            yield job

    with closing(executor.run(jobs(), worker_jobs.doubles)) as results:
        next(results)
        assert 1 <= len(taken) <= 1 + 2 * executor.workers


@pytest.mark.parametrize(
    ("how", "message"),
    [("usage", r"^seed 3: three is too many$"), ("start", r"^seed 0: nothing to start with$")],
)
def test_input_that_cannot_be_used_is_told_in_one_line(
    executor: Executor, how: str, message: str
) -> None:
    start = partial(worker_jobs.complains, how)
    # One at a time: of two that fail, either may be the first.
    with pytest.raises(UsageError, match=message):
        list(
            executor.run([0, 3], start, name=seed)
            if how == "usage"
            else executor.run([0], start, name=seed)
        )


def test_who_stops_before_it_begins_starts_nothing(executor: Executor) -> None:
    start = partial(worker_jobs.complains, "start")
    assert list(executor.run(range(3), start, stop=lambda: True)) == []


# --- this process


def test_in_this_process_results_come_while_their_job_goes_on_and_errors_are_raised() -> None:
    given: list[int] = []

    def start(stop: Any) -> Any:
        def work(job: int) -> Iterator[int]:
            while not stop():
                given.append(job)
                yield job

        return work

    done = list(InProcessExecutor().run([7, 8], start, stop=lambda: len(given) == 3))
    assert done == [(7, 7)] * 3
    with pytest.raises(RuntimeError, match="three"):
        list(InProcessExecutor().run([3], partial(worker_jobs.complains, "broken")))


def test_one_worker_is_this_process_where_that_is_allowed() -> None:
    for settings, allowed, kind in (
        (ExecutorSettings(), True, InProcessExecutor),
        (ExecutorSettings(workers=1), True, InProcessExecutor),
        (ExecutorSettings(workers=1), False, ProcessExecutor),
        (ExecutorSettings(workers=2), True, ProcessExecutor),
    ):
        with open_executor(settings, in_process=allowed) as executor:
            assert isinstance(executor, kind)


# --- processes


def test_no_more_processes_than_workers() -> None:
    with ProcessExecutor(2) as executor:
        done = list(executor.run(range(20), worker_jobs.doubles))
    assert sorted(double for _, (double, _) in done) == [2 * job for job in range(20)]
    pids = {pid for _, (_, pid) in done}
    assert 1 <= len(pids) <= 2
    assert os.getpid() not in pids
    assert not any(is_running(pid) for pid in pids)


@pytest.mark.parametrize("make", [InProcessExecutor, partial(ProcessExecutor, 1)])
def test_who_waits_is_told_that_kernels_are_compiled(make: Callable[[], Any]) -> None:
    heard: list[bool] = []
    with closing(make().run([1], worker_jobs.compiles, compiling=heard.append)) as results:
        assert list(results) == [(1, 2)]
    assert heard == [True, False]


def test_each_worker_starts_once_and_no_more_start_than_there_are_jobs(tmp_path: Path) -> None:
    start = partial(worker_jobs.counted, tmp_path)
    with ProcessExecutor(5) as executor:
        assert sorted(executor.run(range(2), start)) == [(0, 0), (1, 1)]
    assert 1 <= len(list(tmp_path.glob("start-*"))) <= 2
    assert len(list(tmp_path.glob("job-*"))) == 2


@pytest.mark.nightly
def test_a_worker_lives_on_over_the_runs_and_starts_each_anew(tmp_path: Path) -> None:
    with ProcessExecutor(1) as executor:
        ((_, (_, first)),) = executor.run([1], worker_jobs.doubles)
        start = partial(worker_jobs.counted, tmp_path)
        assert sorted(executor.run(range(3), start)) == [(job, job) for job in range(3)]
        assert [path.name for path in tmp_path.glob("start-*")] == [f"start-{first}"]
        # A worker lost while idle is replaced at its next turn. No job counts as failed.
        os.kill(first, signal.SIGKILL)
        # All of its threads: a zombie may still have some, and is not to be waited for then.
        alive = multiprocessing.active_children
        wait_until(lambda: first not in [child.pid for child in alive()], "a worker to end", 30.0)
        lost: list[str] = []
        ((_, (_, second)),) = executor.run([1], worker_jobs.doubles, lost=lost.append)
        assert second != first
        assert lost == []
    assert not is_running(second)


@pytest.mark.nightly
def test_a_slow_job_holds_nobody_up(tmp_path: Path) -> None:
    # Dealt out beforehand, half of the others would wait for the first, and it for them.
    start = partial(worker_jobs.all_but_the_first, tmp_path, 9)
    with ProcessExecutor(2) as executor:
        done = [job for job, _ in executor.run(range(9), start)]
    assert done[-1] == 0
    assert sorted(done) == list(range(9))


def test_a_worker_has_one_thread_and_is_deaf_to_ctrl_c() -> None:
    before = dict(os.environ)
    with ProcessExecutor(1) as executor:
        ((_, told),) = executor.run([1], worker_jobs.surroundings)
    assert told["threads"] == ONE_THREAD
    assert told["deaf"]
    assert dict(os.environ) == before
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, set())


@pytest.mark.parametrize(
    ("how", "name"),
    [
        ("kill", "SIGKILL"),
        pytest.param("exit", "exit status 7", marks=pytest.mark.nightly),
        ("half", "exit status 7"),
    ],
)
def test_the_job_of_a_lost_worker_is_given_to_another(tmp_path: Path, how: str, name: str) -> None:
    lost: list[str] = []
    start = partial(worker_jobs.dies, tmp_path, 2, how)
    with ProcessExecutor(2) as executor:
        done = executor.run(range(6), start, name=seed, lost=lost.append)
        assert sorted(done) == [(job, job) for job in range(6)]
    assert lost == [f"a worker was lost by {name}: seed 3 begins again"] * 2


@pytest.mark.nightly
def test_a_job_that_loses_three_workers_ends_it_all(tmp_path: Path) -> None:
    start = partial(worker_jobs.dies, tmp_path, 3, "kill")
    done = []
    message = r"^seed 3: lost 3 workers, the last one by SIGKILL$"
    with ProcessExecutor(1) as executor, pytest.raises(WorkerError, match=message):
        for job, _ in executor.run(range(6), start, name=seed):
            done.append(job)
    assert done == [0, 1, 2]
    assert len(list(tmp_path.iterdir())) == 3


def test_a_broken_job_is_told_in_one_line() -> None:
    start = partial(worker_jobs.complains, "broken")
    message = r"^seed 3: RuntimeError: three lines of trouble$"
    with ProcessExecutor(1) as executor, pytest.raises(WorkerError, match=message):
        list(executor.run(range(6), start, name=seed))


def test_whoever_stops_does_not_wait_for_what_is_under_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executors, "END_S", 3600.0)

    def both_sleep() -> bool:
        return len(list(tmp_path.glob("pid-*"))) == 2

    start = partial(worker_jobs.sleeps, tmp_path)
    with ProcessExecutor(2) as executor:
        done = executor.run(range(4), start, stop=both_sleep)
        assert sorted(job for job, _ in done) == [0, 1]
    for path in tmp_path.glob("pid-*"):
        assert not is_running(int(path.read_text()))


def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    jobs = tmp_path / "jobs"
    jobs.mkdir()
    words = ["-m", "tests.support.worker_jobs", str(jobs)]
    with running(words, tmp_path, path=ROOT) as parent:
        wait_until(lambda: len(list(jobs.glob("pid-*"))) == 2, "two jobs that never end")
        pids = [int(path.read_text()) for path in jobs.glob("pid-*")]
        assert all(is_running(pid) for pid in pids)
        parent.process.send_signal(signal.SIGKILL)
        for pid in pids:
            wait_until(partial(has_ended, pid), "an orphan to end", 30.0)
        # The output stays empty: no traceback of an interrupted worker.
        assert parent.text() == ""


# --- Ray


@NEEDS_RAY
@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_a_worker_of_ray_has_one_thread_and_starts_once(
    ray_executor: Executor, tmp_path: Path
) -> None:
    ((_, told),) = ray_executor.run([1], worker_jobs.surroundings)
    assert told["threads"] == ONE_THREAD
    done = list(ray_executor.run(range(6), partial(worker_jobs.counted, tmp_path)))
    assert len(done) == len(list(tmp_path.glob("job-*"))) == 6
    assert 1 <= len(list(tmp_path.glob("start-*"))) <= 2


@NEEDS_RAY
@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_the_job_of_a_lost_worker_of_ray_begins_again_twice(
    ray_executor: Executor, tmp_path: Path
) -> None:
    lost: list[str] = []
    for times, folder in ((2, tmp_path / "twice"), (3, tmp_path / "too-often")):
        folder.mkdir()
        start = partial(worker_jobs.dies, folder, times, "kill")
        results = ray_executor.run(range(6), start, name=seed, lost=lost.append)
        if times == 2:
            assert sorted(results) == [(job, job) for job in range(6)]
            assert len(lost) == 2
            assert all(told.endswith("seed 3 begins again") for told in lost)
        else:
            with pytest.raises(WorkerError, match=r"^seed 3: lost 3 workers, the last one by"):
                list(results)


@NEEDS_RAY
@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_a_local_ray_listens_on_loopback_only(ray_executor: Executor) -> None:
    list(ray_executor.run(range(2), worker_jobs.pairs))
    here = psutil.Process()
    listening = {
        socket.laddr.ip
        for process in (here, *here.children(recursive=True))
        for socket in process.net_connections("inet")
        if socket.status == psutil.CONN_LISTEN
    }
    assert listening
    assert listening <= {"127.0.0.1", "::ffff:127.0.0.1", "::1"}


@NEEDS_RAY
@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_a_local_ray_rejects_clients_without_its_token(
    ray_executor: Executor, tmp_path: Path
) -> None:
    import ray

    list(ray_executor.run(range(2), worker_jobs.pairs))
    address = ray.get_runtime_context().gcs_address
    environment = {k: v for k, v in os.environ.items() if not k.startswith("RAY_AUTH")}
    told = subprocess.run(
        [sys.executable, "-c", f"import ray; ray.init({address!r}); print('connected')"],
        env=environment | {"HOME": f"{tmp_path}"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert told.returncode != 0
    assert "connected" not in told.stdout
    assert "oken is missing" in told.stderr


@NEEDS_RAY
@pytest.mark.slow
@pytest.mark.xdist_group("ray")
def test_a_worker_of_ray_with_other_code_is_refused(
    ray_executor: Executor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = {**package_versions(), "numpy": "0.1"}
    monkeypatch.setattr("airl_mav.addons.ray.executor.package_versions", lambda: other)
    with pytest.raises(UsageError, match=r"has other code: numpy \S+, not 0.1; accepted: the same"):
        list(ray_executor.run([1], partial(worker_jobs.counted, tmp_path)))


@NEEDS_RAY
@pytest.mark.slow
def test_a_ray_that_cannot_start_is_told_in_one_line(tmp_path: Path) -> None:
    words = ("evaluate", "greedy", "--level", "lockstep", "--episodes", "1", "--executor", "ray")
    told = subprocess.run(
        [sys.executable, "-m", "airl_mav.cli.main", *words, "--out", f"{tmp_path / 'run'}"],
        env=os.environ | {"RAY_TMPDIR": "/proc/none"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert told.returncode == 2
    assert "--ray-address local: " in told.stderr + told.stdout
    assert "Traceback" not in told.stderr + told.stdout


@NEEDS_RAY
@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"RAY_AUTH_MODE": "disabled"}, "RAY_AUTH_MODE 'disabled': accepted: token"),
        ({"RAY_AUTH_TOKEN": ""}, "ray_address 'auto': no token in RAY_AUTH_TOKEN or "),
    ],
)
def test_a_cluster_needs_a_token(
    variables: dict[str, str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (variables | {"HOME": f"{tmp_path}"}).items():
        monkeypatch.setenv(name, value)
    settings = ExecutorSettings(executor="ray", ray_address="auto")
    with pytest.raises(UsageError, match=message), open_executor(settings):
        pass


@NEEDS_RAY
@pytest.mark.parametrize(
    ("address", "message"),
    [("127.0.0.1:9", "ray_address '127.0.0.1:9': "), ("nowhere", "accepted: local, auto, ")],
)
def test_ray_where_there_is_none_is_told_in_one_line(address: str, message: str) -> None:
    settings = ExecutorSettings(executor="ray", ray_address=address)
    with pytest.raises(UsageError, match=message), open_executor(settings):
        pass


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("airl_mav.addons.ray.executor.find_spec", lambda _: None)
    with (
        pytest.raises(
            UsageError, match=r"executor 'ray': not installed: pip install 'airl-mav\[ray\]'"
        ),
        open_executor(ExecutorSettings(executor="ray")),
    ):
        pass
