"""A flight mode added as docs/architecture.md says: a member of `Mode` and a file in `modes/`."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from airl_mav.faults import PHASES
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.autopilot_state import Result
from firmware_sim.autopilot.flight_modes import BY_CUSTOM_MODE, Mode
from firmware_sim.autopilot.modes import implementations
from firmware_sim.autopilot.parameter_store import Parameters
from tests.support.processes import ROOT

AUTOPILOT = ROOT / "firmware_sim" / "autopilot"
LAST_MEMBER = '    """Landing on a reported landing target."""\n'

MEMBER = """\
    DRIFT = ModeSpec(16, "Drift", MAIN_AUTO, 11, 23, NavigationMode.EXTERNAL1, _GUIDED)
"""

FILE = '''\
"""Drift: fly east at 1 m/s."""

from airl_mav.control.demand import Demand
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.modes.interface import FREE, NAN, FlightContext, FlightMode


class Drift(FlightMode, modes=(Mode.DRIFT,)):
    """Drift mode."""

    def __init__(self, context: FlightContext, /) -> None:
        pass

    def demand(self, _state, _time_us, /):
        return Demand(FREE, (0.0, 1.0, 0.0), 0.0, NAN)
'''

# Only these two parts of the package come from the other tree, so that no kernel is compiled again.
FLIGHT = """\
import json, sys

import firmware_sim.autopilot

firmware_sim.autopilot.__path__.insert(0, sys.argv[1])

from firmware_sim.autopilot.commander import FlightPhase
from firmware_sim.autopilot.events.health_report import EXTERNAL_MODES
from firmware_sim.autopilot.flight_modes import Mode
from tests.firmware.test_mavlink_failure import Aloft


def until(reached):
    for _ in range(300):
        if reached():
            return
        aloft.run(0.1)
    raise AssertionError(aloft.client.received("STATUSTEXT"))


def result(*command):
    aloft.client.received()
    aloft.client.command(*command)
    aloft.run(0.02)
    return [ack.result for ack in aloft.client.received("COMMAND_ACK")]


aloft = Aloft()
flight = lambda: aloft.autopilot.flight
until(lambda: result(400, 1) == [0])
answers = [result(22)]
until(lambda: flight().phase is FlightPhase.AIR and flight().mode is Mode.HOLD)
aloft.client.received()
aloft.client.command(512, 435, 0)
aloft.run(0.1)
listed = [(m.mode_name, m.custom_mode) for m in aloft.client.received("AVAILABLE_MODES")]
answers.append(result(176, 1, 4, 11))
entered, began = flight().mode.name, aloft.simulation.truth.position.tolist()
aloft.run(5.0)
ended = aloft.simulation.truth.position.tolist()
print(json.dumps({
    "answers": answers,
    "listed": listed,
    "entered": entered,
    "reported": aloft.client.received("HEARTBEAT")[-1].custom_mode,
    "unsupported": EXTERNAL_MODES,
    "way": [b - a for a, b in zip(began, ended)],
}))
"""


def test_a_mode_is_added_with_two_files_and_flown(tmp_path: Path) -> None:
    changed = tmp_path / "autopilot"
    kept = shutil.ignore_patterns("__pycache__")
    shutil.copytree(AUTOPILOT / "modes", changed / "modes", ignore=kept)
    table = (AUTOPILOT / "flight_modes.py").read_text()
    assert table.count(LAST_MEMBER) == 1
    table = table.replace(LAST_MEMBER, LAST_MEMBER + MEMBER)
    (changed / "flight_modes.py").write_text(table)
    (changed / "modes" / "drift.py").write_text(FILE)

    files = [path.relative_to(changed) for path in changed.rglob("*.py")]
    there = {file: AUTOPILOT / file for file in files if (AUTOPILOT / file).exists()}
    edited = [f for f, old in there.items() if old.read_bytes() != (changed / f).read_bytes()]
    assert (edited, len(files) - len(there)) == ([Path("flight_modes.py")], 1)

    done = subprocess.run(
        [sys.executable, "-c", FLIGHT, str(changed)], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    number = 4 << 16 | 11 << 24
    assert found["answers"] == [[0], [0]]
    assert ["Drift", number] in found["listed"]
    assert len(found["listed"]) == len(BY_CUSTOM_MODE) + 1
    assert (found["entered"], found["reported"]) == ("DRIFT", number)
    assert found["unsupported"] == 0xFE << 23
    north, east, down = found["way"]
    assert 3.5 < east < 5.0 and abs(north) < 0.4 and abs(down) < 0.4


def test_a_mode_of_a_missing_addon_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    left = {mode: new for mode, new in implementations().items() if mode is not Mode.ORBIT}
    monkeypatch.setattr("firmware_sim.autopilot.guidance.implementations", lambda: left)
    autopilot = BuiltinAutopilot(Parameters())
    assert autopilot.set_mode(Mode.ORBIT) is Result.TEMPORARILY_REJECTED
    texts = [message.text for message in autopilot.take_messages()]
    assert texts == ["Switching to Orbit is currently not available"]


def test_the_table_is_complete() -> None:
    assert set(Mode) - set(implementations()) == {Mode.TERMINATION}
    assert len({mode.spec.state for mode in Mode}) == len(Mode)
    assert set(Mode) - set(BY_CUSTOM_MODE.values()) == {Mode.DESCEND}
    assert {mode.spec.phase for mode in Mode} <= {*PHASES, None}
