"""Clocks: what simulated time is, and that nothing else reads the host's."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from airl_mav.core.clock import SimClock, WallClock

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(
    p
    for top in ("airl_mav", "firmware_sim", "companion")
    for p in (ROOT / top).rglob("*.py")
    if "__pycache__" not in p.parts  # what is generated there is pymavlink's
)
CLOCK = ROOT / "airl_mav" / "core" / "clock.py"
CLOCK_CALLS = {"os.times", "asyncio.sleep", "loop.time", "datetime.now", "date.today"}
SEEDED = {"Generator", "default_rng", "SeedSequence"}
S_NS, S_US = 1_000_000_000, 1_000_000


class Host:
    """Stands in for the host's clock: time passes only when somebody sleeps or says so."""

    def __init__(self) -> None:
        self.now_ns = 5_000 * S_NS
        self.slept_s: list[float] = []

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.slept_s.append(seconds)
        # Rounded down: a sleep that comes back a little early must not be believed.
        self.now_ns += 1 + int(seconds * S_NS * 0.999)


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> Host:
    host = Host()
    monkeypatch.setattr("airl_mav.core.clock.time", host)
    return host


# --- simulated


def test_sim_clock_moves_only_by_its_owner() -> None:
    clock = SimClock(7)
    assert clock.time_us() == clock.time_us() == 7
    clock.advance(4_000)
    clock.advance(0)
    assert clock.time_us() == 4_007


def test_sim_clock_sleeps_forward_only() -> None:
    clock = SimClock()
    clock.sleep_until(100)
    assert clock.time_us() == 100
    clock.sleep_until(50)
    assert clock.time_us() == 100


def test_sim_clock_refuses_to_go_back() -> None:
    with pytest.raises(ValueError, match="cannot go back"):
        SimClock().advance(-1)


# --- wall, on a host whose time stands still


@pytest.mark.parametrize("speed", [0.25, 1.0, 2.0, 16.0])
def test_speed_scales_time(host: Host, speed: float) -> None:
    clock = WallClock(speed)
    assert clock.time_us() == 0
    host.now_ns += 3 * S_NS
    assert clock.time_us() == int(3 * S_US * speed)
    assert clock.wall_seconds_until(int(3 * S_US * speed)) == 0.0
    assert clock.wall_seconds_until(int(4 * S_US * speed)) == pytest.approx(1.0)
    assert clock.wall_seconds_until(0) == pytest.approx(-3.0)


@pytest.mark.parametrize("speed", [0.5, 1.0, 3.0])
def test_sleep_ends_on_time_and_never_early(host: Host, speed: float) -> None:
    clock = WallClock(speed)
    clock.sleep_until(6 * S_US)
    assert 0 <= clock.time_us() - 6 * S_US <= 2
    assert sum(host.slept_s) == pytest.approx(6.0 / speed, rel=0.01)
    host.slept_s.clear()
    clock.sleep_until(5 * S_US)
    assert host.slept_s == []


def test_two_clocks_of_one_epoch_read_the_same(host: Host) -> None:
    one = WallClock(2.0)
    host.now_ns += 12_345_678
    other = WallClock(2.0, one.epoch_ns)
    for _ in range(100):
        host.now_ns += 1_234_567
        assert one.time_us() == other.time_us() > 0


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_slip_gives_up_simulated_time(host: Host, speed: float) -> None:
    clock = WallClock(speed)
    host.now_ns += 10 * S_NS
    before = clock.time_us()
    clock.slip(300_000)
    assert clock.time_us() == before - 300_000
    host.now_ns += S_NS
    assert clock.time_us() == before - 300_000 + int(S_US * speed)


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_speed_that_is_none_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="speed"):
        WallClock(speed)


# --- wall, on the real host: what holds however busy it is


def test_time_never_goes_back() -> None:
    clock = WallClock(5.0)
    times = [clock.time_us() for _ in range(2_000)]
    assert times == sorted(times)


def test_a_shared_epoch_orders_readings_of_two_clocks() -> None:
    one = WallClock(3.0)
    other = WallClock(3.0, one.epoch_ns)
    readings = [c.time_us() for _ in range(500) for c in (one, other)]
    assert readings == sorted(readings)


def test_sleep_has_lasted_at_least_as_long_as_asked() -> None:
    clock = WallClock()
    clock.sleep_until(2_000)
    assert clock.time_us() >= 2_000


# --- nobody else


class Names(NamedTuple):
    """What there is in a file."""

    imported: set[str]
    used: set[str]
    """Dotted names."""
    unseeded: list[int]
    """Lines that make a generator without a seed."""


def dotted(node: ast.expr) -> str:
    """Return a dotted name; empty for an attribute of anything else than a name."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (before := dotted(node.value)):
        return f"{before}.{node.attr}"
    return ""


@cache
def names_in(source: Path) -> Names:
    """Read a file."""
    found = Names(set(), set(), [])
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            found.imported.update(f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            found.imported.update(alias.name for alias in node.names)
        elif isinstance(node, ast.Attribute):
            found.used.add(dotted(node))
        elif isinstance(node, ast.Call) and not node.args:
            called = node.func
            name = called.attr if isinstance(called, ast.Attribute) else dotted(called)
            if name in SEEDED:
                found.unseeded.append(node.lineno)
    return found


def offenders(found: dict[Path, set[str]]) -> dict[str, set[str]]:
    return {str(path.relative_to(ROOT)): names for path, names in found.items() if names}


def test_there_are_sources_to_look_at() -> None:
    assert len(SOURCES) > 80
    imported, used, _ = names_in(CLOCK)
    assert "time" in imported
    assert {"time.monotonic_ns", "time.sleep", "datetime.now"} <= used


def test_only_the_clock_reads_the_hosts_time() -> None:
    found = {}
    for source in set(SOURCES) - {CLOCK}:
        imported, used, _ = names_in(source)
        found[source] = {n for n in imported if n.split(".")[0] in ("time", "datetime")}
        found[source] -= {"datetime.timedelta"}  # A duration: it reads no clock.
        found[source] |= {n for n in used if n in CLOCK_CALLS}
    assert offenders(found) == {}


LEARNER_STATE = ROOT / "airl_mav" / "training" / "checkpoint.py"
"""Draws nothing: saves and restores the global generators, which stable-baselines3 draws from."""


def test_randomness_is_drawn_from_generators_that_are_handed_in() -> None:
    found = {}
    for source in set(SOURCES) - {LEARNER_STATE}:
        imported, used, unseeded = names_in(source)
        found[source] = {n for n in imported if n.split(".")[0] == "random"}
        drawn = {n for n in used if n.startswith(("np.random.", "numpy.random."))}
        found[source] |= {n for n in drawn if n.split(".")[2] not in SEEDED}
        found[source] |= {f"no seed in line {line}" for line in unseeded}
    assert offenders(found) == {}
