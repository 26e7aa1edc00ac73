"""Make the calls of a MAVSDK program at a running firmware, and compare the answers with PX4's.

    airl-firmware --speed 3 &
    python scripts/px4_walk.py                              # ours
    python scripts/px4_walk.py --connect udpin://0.0.0.0:14540 --slow   # or a real PX4's

Prints a line for each call, with its wall time; exit status 1 if an answer differs. Calls that a
real PX4 does not answer take seconds each, and require --slow.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

from mavsdk import ComponentType, Configuration, Mavsdk

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.support.mavlink_clients import Companion
from tests.support.px4_walk.row import answered
from tests.support.px4_walk.rows import ROWS
from tests.support.px4_walk.vehicle import Vehicle


def main() -> int:
    """Make the calls; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--connect", default="udpin://127.0.0.1:14540", help="MAVSDK connection")
    parser.add_argument("--system", type=int, default=1, help="MAVLink system id of the vehicle")
    parser.add_argument("--area", help="only the calls of this area")
    parser.add_argument("--slow", action="store_true", help="also the calls that time out")
    parser.add_argument("--json", type=Path, help="file for the answers")
    asked = parser.parse_args()
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    mavsdk = Mavsdk(configuration)
    if mavsdk.add_any_connection(asked.connect) != 0:
        parser.error(f"--connect {asked.connect}: cannot be used")
    companion = Companion(mavsdk)
    vehicle = Vehicle(companion, asked.system)
    differ, answers = 0, []
    for row in ROWS:
        if (row.slow and not asked.slow) or asked.area not in (None, row.area):
            continue
        began = time.monotonic()
        answer = answered(row, vehicle)
        took_s = time.monotonic() - began
        differ += not answer.agrees
        mark = "agrees " if answer.agrees else "DIFFERS"
        shown = "" if answer.value is None else f"  {answer.value!s:.60}"
        line = f"{mark}  {row.name:<55} PX4 {row.expected[0]:<20} {took_s:6.2f} s  {answer.outcome}"
        print(line + shown, flush=True)
        value = None if answer.value is None else f"{answer.value!s:.200}"
        answers.append(
            {"name": row.name, "outcome": answer.outcome, "agrees": answer.agrees, "value": value}
        )
    print(f"{len(answers) - differ} of {len(answers)} calls answered as by PX4 1.16")
    companion.destroy()
    if asked.json is not None:
        asked.json.write_text(json.dumps(answers, indent=1) + "\n")
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
