"""The pilot's sticks: from a joystick (MANUAL_CONTROL) or a radio (RC_CHANNELS_OVERRIDE).

Source: PX4 1.16, ManualControlSelector.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S

FOLLOWED_S = 0.3
"""Time constant with which the rest position follows the sticks [s]: what differs from it moves."""


class Sticks(NamedTuple):
    """Deflections -1..1."""

    roll: float
    """Right positive."""
    pitch: float
    """Forward positive."""
    throttle: float
    """Up positive; 0 = the centre."""
    yaw: float
    """Clockwise positive."""


class Source(Enum):
    """Source of sticks."""

    RADIO = auto()
    JOYSTICK = auto()


_ALLOWED = {
    0: (Source.RADIO,),
    1: (Source.JOYSTICK,),
    2: (Source.RADIO, Source.JOYSTICK),
    3: (Source.RADIO, Source.JOYSTICK),
}
"""By COM_RC_IN_MODE; 3 stays with the first one, 4 takes none."""


class ManualControl:
    """The newest sticks of the source that counts."""

    def __init__(self, value: Callable[[str], float]) -> None:
        """Take a lookup of PX4 parameter names."""
        self._value = value
        self.was_heard = False
        """Whether any sticks were taken since boot."""
        self._sticks: Sticks | None = None
        self._source: Source | None = None
        self._time_us = 0
        self._rest = Sticks(0.0, 0.0, 0.0, 0.0)

    def offer(self, sticks: Sticks, source: Source, time_us: int) -> bool:
        """Take sticks, if their source counts; return whether the pilot moves them.

        They move if one differs from where it was by more than COM_RC_STICK_OV [%].
        """
        mode = int(self._value("COM_RC_IN_MODE"))
        if source not in _ALLOWED.get(mode, ()):
            return False
        fresh = self.sticks(time_us) is not None
        held = fresh or mode == 3
        if held and self._source is not None and source is not self._source:
            return False
        if not fresh:
            self._rest = sticks
        elapsed_s = (time_us - self._time_us) / US_PER_S
        weight = min(1.0, elapsed_s / (elapsed_s + FOLLOWED_S)) if elapsed_s > 0.0 else 0.0
        self._rest = Sticks(
            *(r + weight * (s - r) for r, s in zip(self._rest, sticks, strict=True))
        )
        self.was_heard = True
        self._sticks, self._source, self._time_us = sticks, source, time_us
        limit = self._value("COM_RC_STICK_OV") / 100.0
        return any(abs(s - r) > limit for s, r in zip(sticks, self._rest, strict=True))

    def sticks(self, time_us: int) -> Sticks | None:
        """Return the sticks, None when there are none or none for COM_RC_LOSS_T."""
        limit_us = self._value("COM_RC_LOSS_T") * US_PER_S
        if self._sticks is None or time_us - self._time_us > limit_us:
            return None
        return self._sticks
