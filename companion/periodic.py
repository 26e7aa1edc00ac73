"""Thread that calls a function periodically while a context is active."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from airl_mav.core.clock import Clock


@contextmanager
def every(period_us: int, act: Callable[[], object], clock: Clock, name: str) -> Iterator[None]:
    """Call `act` immediately and once per period [µs] in a named thread, skipping missed calls."""
    ended = threading.Event()

    def go_on() -> None:
        due_us = clock.time_us()
        while not ended.is_set():
            act()
            due_us = max(due_us + period_us, clock.time_us())
            clock.sleep_until(due_us, ended)

    thread = threading.Thread(target=go_on, name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
