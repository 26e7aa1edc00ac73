"""Stand-alone firmware: runs until stopped, then prints a summary."""

from __future__ import annotations

import threading
from collections.abc import Callable

from airl_mav.core.clock import WallClock
from airl_mav.core.constants import US_PER_S
from firmware_sim.firmware import Firmware


def fly(
    firmware: Firmware,
    stop: threading.Event,
    duration_s: float | None,
    say: Callable[[str], None],
) -> None:
    """Fly until `stop` is set, or for a duration of simulated time [s]; report a summary.

    Without a duration, only `stop` ends the flight. `say` receives one line at a time. Raises
    FirmwareLostError when real firmware is lost.
    """
    start_us, stopwatch = firmware.clock.time_us(), WallClock()
    end_us = None if duration_s is None else start_us + int(duration_s * US_PER_S)
    while not stop.is_set() and (end_us is None or firmware.clock.time_us() < end_us):
        firmware.step()
    flown_s = (firmware.clock.time_us() - start_us) / US_PER_S
    wall_s = max(stopwatch.time_us(), 1) / US_PER_S
    say(f"{flown_s:.1f} s simulated in {wall_s:.1f} s: {flown_s / wall_s:.2f} x real time")
    if firmware.slipped_us:
        given_up_s = firmware.slipped_us / US_PER_S
        say(f"{given_up_s:.2f} s given up: this host could not keep up")
    for name, link in firmware.flight_stack.counters().items():
        say(
            f"{name:<8} received {link.rx}, malformed {link.malformed}, ignored {link.ignored}, "
            f"dropped {link.dropped}, "
            f"refused {link.refused}, sent {link.tx}, not sent {link.send_errors}"
        )
