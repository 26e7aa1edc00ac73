"""Flights on two Ray nodes of one machine stay equal if one node is killed.

    sudo python scripts/ray_two_nodes.py [--episodes 24] [--out DIR]

Creates two network namespaces joined by a veth pair, starts a Ray head in one and a Ray node in the
other, and runs a lockstep evaluation and a small sweep over both. During each, every process of the
second node is killed (kill -9); in between it joins again. Afterwards it compares with the same
work done by worker processes: SHA-256 of every flight and of every trained policy, no episode lost,
none twice. Needs Linux, root, iproute2 and `pip install 'airl-mav[sim,train,ray]'`.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from airl_mav.addons.sweep.command import run_sweep
from airl_mav.addons.sweep.config import load_sweep
from airl_mav.core.progress import RichProgress, new_console
from airl_mav.experiments.campaign import Cell, run_cell
from airl_mav.experiments.executors import ExecutorSettings, open_executor
from airl_mav.policy.card import read_card
from airl_mav.scenario.model import Scenario
from airl_mav.scenario.resolve import resolve

ROOT = Path(__file__).resolve().parents[1]
HEAD, NODE = "10.99.0.1", "10.99.0.2"
PORT = 6399
RAY = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
}
"""Environment of this cluster: only its machines know the token."""
PATIENCE_S = 200.0
STEPS = 2_000
"""Decisions of each training: long enough for a kill."""


@dataclass(frozen=True)
class Command:
    """Kill one of two Ray nodes, and compare."""

    episodes: int = 24
    """Flights in lockstep."""

    out: Path = Path("runs/ray-two-nodes")
    """Folder of all results; emptied first."""


# --- the work, wherever it is done


def lockstep_cell(episodes: int) -> Cell:
    scenario = Scenario(level="lockstep", episodes=episodes, time_limit_s=60.0)
    return Cell("lockstep", "lockstep", resolve(scenario))


def work(what: str, out: Path, episodes: int, address: str | None) -> int:
    """Fly the evaluation or run the sweep; return the exit status."""
    settings = ExecutorSettings(workers=2)
    if address is not None:
        settings = ExecutorSettings(executor="ray", ray_address=address)
    with RichProgress(new_console(soft_wrap=True)) as progress, open_executor(settings) as executor:
        if what == "lockstep":
            run = run_cell(out / what, lockstep_cell(episodes), executor, progress=progress)
            complete, error = run.complete, run.error
        else:
            config = load_sweep("tiny")
            data = config.model_dump(exclude_unset=True)
            data["training"]["steps"] = STEPS
            config = type(config).model_validate(data)
            sweep, error = run_sweep(
                out / what, config, executor, command="ray_two_nodes.py", progress=progress
            )
            complete = sweep.ended == sweep.planned
    if error is not None:
        progress.note(error, "red")
    return 0 if complete else 1


# --- two nodes


def ip(*words: str) -> str:
    done = subprocess.run(["ip", *words], check=True, capture_output=True, text=True)  # noqa: S607
    return done.stdout


@contextmanager
def namespaces() -> Iterator[tuple[str, str]]:
    """Create two network namespaces connected only to each other."""
    names = f"airl-a{os.getpid()}", f"airl-b{os.getpid()}"
    links = f"va{os.getpid()}", f"vb{os.getpid()}"
    with ExitStack() as stack:
        for name in names:
            ip("netns", "add", name)
            stack.callback(ip, "netns", "del", name)
        ip("link", "add", links[0], "type", "veth", "peer", "name", links[1])
        for name, link, address in zip(names, links, (HEAD, NODE), strict=True):
            ip("link", "set", link, "netns", name)
            ip("-n", name, "addr", "add", f"{address}/24", "dev", link)
            ip("-n", name, "link", "set", link, "up")
            ip("-n", name, "link", "set", "lo", "up")
        for name in names:
            stack.callback(kill_in, name)
        yield names


def pids(namespace: str) -> list[int]:
    return [int(pid) for pid in ip("netns", "pids", namespace).split()]


def kill_in(namespace: str) -> None:
    kill(pids(namespace))


def kill(victims: list[int]) -> None:
    for pid in victims:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def start(namespace: str, words: list[str], log: Path) -> subprocess.Popen[bytes]:
    """Start a Python program in a namespace."""
    path = f"{ROOT}{os.pathsep}{ROOT / 'scripts'}"
    environment = os.environ | RAY | {"PYTHONPATH": path}
    with log.open("ab") as file:
        return subprocess.Popen(
            ["ip", "netns", "exec", namespace, sys.executable, *words],  # noqa: S607
            stdout=file,
            stderr=file,
            env=environment,
            cwd=ROOT,
        )


def ray_start(namespace: str, address: str, log: Path) -> subprocess.Popen[bytes]:
    head = ["--head", f"--port={PORT}", "--include-dashboard=false"]
    if address != HEAD:
        head = [f"--address={HEAD}:{PORT}"]
    options = [f"--node-ip-address={address}", "--num-cpus=1", "--block"]
    options += [f"--object-store-memory={256 * 2**20}"]
    main = "from ray.scripts.scripts import main; main()"
    return start(namespace, ["-c", main, "start", *head, *options], log)


def at_work(namespace: str) -> bool:
    """Return True if a process of a namespace executes a job."""
    for pid in pids(namespace):
        with suppress(OSError):
            if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::_carry_out"):
                return True
    return False


def wait_for(what: str, condition: Callable[[], Any], driver: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if driver.poll() is not None:
            raise SystemExit(f"ended with {driver.returncode} before {what}")
        if time.monotonic() > deadline:
            raise SystemExit(f"waited in vain for {what}")
        time.sleep(0.05)


def over_two_nodes(command: Command, console: Console) -> None:
    """Do all the work on two nodes, and kill the second one in the middle of each."""
    out = command.out / "ray"
    with namespaces() as (a, b):
        ray_start(a, HEAD, command.out / "head.log")
        for what, begun in (
            ("lockstep", lambda: lines(out / "lockstep" / "episodes.jsonl") >= 2),
            ("sweep", lambda: any((out / "sweep").glob("*/checkpoints/latest"))),
        ):
            node = ray_start(b, NODE, command.out / "node.log")
            call = f"on_the_head({what!r}, {str(out)!r}, {command.episodes})"
            log = command.out / f"{what}.log"
            driver = start(a, ["-c", f"import ray_two_nodes; ray_two_nodes.{call}"], log)
            wait_for("both nodes are at work", lambda: at_work(a) and at_work(b), driver)
            wait_for("something is kept", begun, driver)
            wait_for("the second node is at work", partial(at_work, b), driver)
            victims = pids(b)
            kill(victims)
            node.wait()
            console.print(f"{what}: both nodes at work; killed all {len(victims)} of the second")
            code = driver.wait()
            console.print(log.read_text(), highlight=False, soft_wrap=True)
            if code != 0:
                raise SystemExit(f"{what}: exit status {code}")


def on_the_head(what: str, out: str, episodes: int) -> None:
    """Do some work from the head's namespace, once the cluster has two nodes."""
    when_both_are_there()
    sys.exit(work(what, Path(out), episodes, f"{HEAD}:{PORT}"))


def when_both_are_there() -> None:
    """Wait until the cluster has two nodes."""
    import ray

    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        with suppress(ConnectionError, RuntimeError):
            ray.init(address=f"{HEAD}:{PORT}", log_to_driver=False, logging_level="ERROR")
            there = sum(node["Alive"] for node in ray.nodes())
            ray.shutdown()
            if there == 2:
                return
        time.sleep(0.5)
    raise SystemExit("the two nodes did not find each other")


# --- results


def lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def flights(out: Path) -> dict[int, str]:
    """Return the digest of each flight by its index; exit on duplicates."""
    found: dict[int, str] = {}
    for line in (out / "lockstep" / "episodes.jsonl").read_text().splitlines():
        record = json.loads(line)
        if record["index"] in found:
            raise SystemExit(f"{out}: episode {record['index']} is there twice")
        found[record["index"]] = record["sha256"]["flight"]
    return dict(sorted(found.items()))


def trainings(out: Path) -> dict[str, Any]:
    """Return figures and digest of the policy of each trial."""
    found = {}
    for cell in json.loads((out / "sweep" / "sweep.json").read_text())["cells"]:
        for result in cell["trials"]:
            del result["trained"]["seconds"]
            trial = result["trial"]
            name = f"{trial['arena']}-{trial['layers']}x{trial['filters']}-seed{trial['seed']}"
            found[name] = result | {"sha256": read_card(out / "sweep" / name / "policy").sha256}
    return found


def main(command: Command) -> int:
    console = new_console()
    if os.geteuid() != 0 or shutil.which("ip") is None:
        raise SystemExit("needs root, and `ip` of iproute2, to make network namespaces")
    command = replace(command, out=command.out.absolute())
    shutil.rmtree(command.out, ignore_errors=True)
    (command.out / "ray").mkdir(parents=True)
    over_two_nodes(command, console)
    for what in ("lockstep", "sweep"):
        work(what, command.out / "processes", command.episodes, None)
    verdicts = []
    for what, found in (("flights", flights), ("trainings", trainings)):
        mine, theirs = found(command.out / "ray"), found(command.out / "processes")
        verdicts.append(mine == theirs)
        verdict = "identical to" if mine == theirs else "NOT those of"
        console.print(f"{what}: {len(mine)}, {verdict} the {len(theirs)} in processes")
    return 0 if all(verdicts) else 1


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Command, description=__doc__)))
