#!/usr/bin/env python3
"""Compare the failsafes of the built-in flight controller with PX4's own code.

    scripts/failsafe_oracle.py ORACLE --release 1.17 [--inputs 100000] [--seed 1] [--record FILE]

ORACLE is PX4's failsafe.cpp and framework.cpp compiled for the host, as PX4's web simulator does
it. It reads one JSON object a line: parameters with `reset`, or an update with the flags of
failsafe_flags; and writes the outcome of each update. Inputs are episodes of random flags, modes
and times with random parameters. Prints the differences by kind; exits with 1 if there are any.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np

from airl_mav.core.constants import US_PER_S
from airl_mav.profiles.px4_release import CURRENT, FailsafeRules, PX4ReleaseName, px4_release
from firmware_sim.autopilot.events.definition import FailsafeAction
from firmware_sim.autopilot.failsafes.failsafe_conditions import (
    BatteryWarning,
    Conditions,
    FailsafeSettings,
    FenceBreach,
)
from firmware_sim.autopilot.failsafes.failsafe_table import Situation
from firmware_sim.autopilot.failsafes.framework import FailsafeState, Intervention, update
from firmware_sim.autopilot.flight_modes import Mode

STEPS = 25
"""Updates of an episode, with the same parameters."""

FAILING = 5
"""Flags that may fail in an episode, besides manual control."""

FLAGS = {name: name for name in Conditions._fields} | {
    "local_position_accuracy_low": "position_accuracy_low",
    "geofence": "geofence_breached",
}
"""Flags of failsafe_flags by the names here."""

VALUES: Mapping[str, tuple[float, ...]] = {
    "com_act_fail_act": (0, 1, 2, 3, 4),
    "com_dll_except": tuple(range(8)),
    "com_fail_act_t": (0.0, 0.1, 1.0, 5.0),
    "com_fltt_low_act": (0, 1, 3),
    "com_low_bat_act": (0, 1, 2, 3),
    "com_obl_rc_act": (0, 1, 2, 3, 4, 5, 6, 7),
    "com_pos_low_act": (0, 1, 2, 3, 4, 5),
    "com_rc_in_mode": (0, 1, 3, 4),
    "com_rcl_except": tuple(range(8)),
    "com_spoolup_time": (0.0, 1.0),
    "cbrk_flightterm": (0, 121212),
    "gf_action": (0, 1, 2, 3, 4, 5),
    "nav_dll_act": (0, 1, 2, 3, 5, 6),
    "nav_rcl_act": (1, 2, 3, 5, 6),
}
"""Values of the parameters. A drawn parameter has its default half of the time."""

TIMES_S = (0.01, 0.1, 0.1, 0.1, 1.0, 2.5, 6.0)
STATES = {mode.spec.state: mode for mode in Mode if mode is not Mode.TERMINATION}
"""Modes by navigation state. Termination is no intended mode: a command terminates at once."""
_HEALTHY = Conditions(
    auto_mission_missing=False,
    offboard_control_signal_lost=False,
    manual_control_signal_lost=False,
    gcs_connection_lost=False,
)


class Outcome(NamedTuple):
    """Compared results of an update, as numbers of PX4."""

    action: int
    nav_state: int
    user_intended_mode: int
    delayed_action: int
    cause: int
    user_takeover_active: bool


def episode(rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return the input of an episode: parameters, then updates without an intended mode."""
    return list(_episode(rng))


def _episode(rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Yield the input of an episode: its parameters, then its updates without an intended mode."""
    parameters = {name: float(rng.choice(values)) for name, values in VALUES.items()}
    defaults = FailsafeSettings._field_defaults
    yield {
        "reset": True,
        "time_us": US_PER_S,
        "parameters": {
            name.upper(): type(defaults[name])(value if rng.random() < 0.5 else defaults[name])
            for name, value in parameters.items()
        },
    }
    flags = {name: False for name in FLAGS if name != "battery_warning"}
    failing = {
        *map(str, rng.choice(list(flags), FAILING, replace=False)),
        "manual_control_signal_lost",
    }
    warning, armed = 0, False
    states = sorted(STATES)
    for _ in range(STEPS):
        for name in sorted(failing):
            if rng.random() < (0.3 if flags[name] else 0.1):
                flags[name] = not flags[name]
        if rng.random() < 0.1:
            warning = int(rng.integers(0, 4))
        armed = armed if rng.random() < (0.03 if armed else 0.5) else not armed
        if rng.random() < 0.5:
            armed = True
        change = bool(rng.random() < 0.15)
        yield {
            "dt_us": round(float(rng.choice(TIMES_S)) * US_PER_S),
            "armed": armed,
            "mode": int(rng.choice(states)) if change else None,
            "user_intended_mode_updated": bool(rng.random() < 0.05),
            "rc_sticks_takeover_request": bool(rng.random() < 0.08),
            "mission_finished": bool(rng.random() < 0.2),
            **{FLAGS[name]: value for name, value in flags.items()},
            "battery_warning": warning,
        }


class Table:
    """Failsafes of the built-in flight controller, driven by the oracle's input."""

    def __init__(self, rules: FailsafeRules) -> None:
        self.rules = rules
        self.reset({})

    def reset(self, parameters: Mapping[str, float]) -> None:
        """Start an episode with parameters."""
        given = {name.lower(): value for name, value in parameters.items()}
        self.settings = FailsafeSettings(**given)  # type: ignore[arg-type]  # by name
        self.state, self.time_us = FailsafeState(), US_PER_S

    def update(self, line: Mapping[str, Any]) -> Outcome:
        """Return the outcome of an update."""
        self.time_us += line["dt_us"]
        seen = {name: line[flag] for name, flag in FLAGS.items()}
        seen["geofence"] = FenceBreach(distance=seen["geofence"])
        seen["battery_warning"] = BatteryWarning(seen["battery_warning"])
        now = Situation(
            *(self.time_us, Conditions(**seen), self.settings, STATES[line["user_intended_mode"]]),
            line["mission_finished"],
            armed=line["armed"],
            rules=self.rules,
        )
        asked = Intervention(line["user_intended_mode_updated"], line["rc_sticks_takeover_request"])
        found = update(self.state, now, asked)
        self.state = found.state
        return Outcome(
            *(int(found.state.action), found.mode.spec.state, found.intended.spec.state),
            *(int(found.delayed), int(found.cause), found.state.taken_over),
        )


Answer = Callable[[Mapping[str, Any]], Mapping[str, Any]]


Compared = tuple[dict[str, Any], Outcome, Outcome]


def compare(lines: Iterable[dict[str, Any]], answer: Answer, table: Table) -> Iterator[Compared]:
    """Yield each update of an episode with PX4's outcome and the table's."""
    mode = Mode.HOLD.spec.state
    for line in lines:
        if "reset" in line:
            answer(line)
            table.reset(line["parameters"])
            continue
        wanted = line.pop("mode")
        line["user_intended_mode"] = mode if wanted is None else wanted
        told = answer(line)
        px4 = Outcome(*(told[name] for name in Outcome._fields))
        if px4.action == FailsafeAction.TERMINATE:
            # PX4 terminates apart from the mode.
            px4 = px4._replace(nav_state=Mode.TERMINATION.spec.state)
        yield line, px4, table.update(line)
        if px4.action == FailsafeAction.TERMINATE:
            return  # for good
        mode = px4.user_intended_mode


def kind(line: Mapping[str, Any], px4: Outcome, here: Outcome) -> str:
    """Return the differing fields with both values, and the failed flags."""
    fields = [
        f"{name} {theirs} here {ours}"
        for name, theirs, ours in zip(Outcome._fields, px4, here, strict=True)
        if theirs != ours
    ]
    failed = [flag for flag in FLAGS.values() if line[flag]]
    return f"{', '.join(fields)} in {STATES[line['user_intended_mode']].name}: {', '.join(failed)}"


class Oracle:
    """PX4's program."""

    def __init__(self, program: Path) -> None:
        self._process = subprocess.Popen(
            [str(program)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __call__(self, line: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the answer to a line."""
        given, read = self._process.stdin, self._process.stdout
        if given is None or read is None:
            raise RuntimeError("no pipes")
        given.write(json.dumps(line) + "\n")
        given.flush()
        told: Mapping[str, Any] = json.loads(read.readline())
        if "error" in told:
            raise ValueError(f"{told['error']}: {line}")
        return told

    def close(self) -> None:
        """End the program."""
        self._process.terminate()
        self._process.wait()


def main() -> int:
    """Compare, and print the differences."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("oracle", type=Path)
    parser.add_argument("--release", choices=get_args(PX4ReleaseName), default=CURRENT)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--shown", type=int, default=20, help="kinds of differences that are printed"
    )
    parser.add_argument("--record", type=Path, help="write PX4's outcomes (JSON) instead")
    parser.add_argument("--without", nargs="*", default=[], help="rules that the oracle lacks")
    asked = parser.parse_args()
    rules = px4_release(asked.release).failsafes
    rules = rules._replace(**dict.fromkeys(asked.without, False))
    oracle, table = Oracle(asked.oracle), Table(rules)
    rng, found, done, recorded = np.random.default_rng(asked.seed), Counter[str](), 0, []
    try:
        while done < asked.inputs:
            for line, px4, here in compare(episode(rng), oracle, table):
                done += 1
                if asked.record is not None:
                    recorded.append(px4)
                elif px4 != here:
                    # Later steps start from another state.
                    found[kind(line, px4, here)] += 1
                    break
    finally:
        oracle.close()
    if asked.record is not None:
        kept = {"release": asked.release, "without": asked.without, "seed": asked.seed}
        text = json.dumps(kept | {"outcomes": recorded}, separators=(",", ":"))
        asked.record.write_text(text.replace("],[", "],\n[") + "\n")
    for text, count in found.most_common(asked.shown):
        print(f"{count:6} {text}")
    print(f"{done} inputs, {found.total()} differences of {len(found)} kinds")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
