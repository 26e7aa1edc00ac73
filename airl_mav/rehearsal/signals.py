"""Signal handlers that stop long work without losing finished results."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True after Ctrl-C or SIGTERM; a second one interrupts at once.

    This allows the caller to save finished work first. Outside the main thread, where Python
    delivers no signals, the function always returns False.
    """
    seen: list[int] = []

    def note(number: int, _frame: object) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(number)

    with signal_handlers(note, signal.SIGINT, signal.SIGTERM):
        yield lambda: bool(seen)


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Treat SIGTERM as Ctrl-C in this context; does nothing outside the main thread."""

    def interrupt(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    with signal_handlers(interrupt, signal.SIGTERM):
        yield


@contextmanager
def signal_handlers(handler: Callable[[int, object], None], *numbers: int) -> Iterator[None]:
    """Handle signals in this context; does nothing outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)
