"""Waiting for the processes of a rehearsal."""

from __future__ import annotations

import pytest

from airl_mav.rehearsal.channel import Ready
from airl_mav.rehearsal.process_pair import LOOK_S, LostError, ProcessPair


def test_compiling_does_not_count_against_the_time_limit() -> None:
    pair, looks, heard = ProcessPair(), 0, list[object]()

    def compiles() -> bool:
        nonlocal looks
        looks += 1
        if looks == 4:
            pair._events.put(("firmware", Ready()))
        return True

    def take(_name: str, event: object) -> bool:
        heard.append(event)
        return True

    # Four looks take longer than the limit.
    pair.pump(take, LOOK_S, "both", compiles)
    assert heard == [Ready()]
    with pytest.raises(LostError, match="gave up waiting for both after 0 s"):
        pair.pump(take, LOOK_S, "both", lambda: False)
