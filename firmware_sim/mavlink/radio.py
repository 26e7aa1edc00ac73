"""The channels of a radio, as the newest RC_CHANNELS_OVERRIDE has them: echoed as RC_CHANNELS.

Source: PX4 1.16, MavlinkReceiver::handle_message_rc_channels_override, streams/RC_CHANNELS.hpp.
"""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import AutopilotState
from firmware_sim.mavlink.codec import Values, WireMessage
from firmware_sim.mavlink.streams import Builder
from firmware_sim.mavlink.streams.units import UINT16_MAX, boot_ms

CHANNELS = 18
_ZERO_SAYS_NOTHING = 8
"""From this channel on 0 says nothing, as UINT16_MAX does for all of them."""
_FULL_SIGNAL = 100


class Radio:
    """What the newest RC_CHANNELS_OVERRIDE said. The same for all clients."""

    def __init__(self) -> None:
        self._said: tuple[int, ...] = ()
        self._time_us = 0
        self._count = 0
        """How many were heard."""

    def hear(self, message: WireMessage, now_us: int) -> None:
        """Take an RC_CHANNELS_OVERRIDE at simulated `now_us` [µs]."""
        said = [getattr(message, f"chan{number}_raw") for number in range(1, CHANNELS + 1)]
        while said and _says_nothing(said[-1], len(said) - 1):
            said.pop()
        self._said, self._time_us = tuple(said), now_us
        self._count += 1

    def updates(self) -> Builder:
        """Return the builder of one link's RC_CHANNELS: each is sent once."""
        sent = self._count

        def build(_state: AutopilotState) -> Values | None:
            nonlocal sent
            if sent == self._count:
                return None
            sent = self._count
            said = self._said
            unused = (UINT16_MAX,) * (CHANNELS - len(said))
            signal = _FULL_SIGNAL if said else 0
            return boot_ms(self._time_us), len(said), *said, *unused, signal

        return build


def _says_nothing(width: int, place: int) -> bool:
    return width == UINT16_MAX or (width == 0 and place >= _ZERO_SAYS_NOTHING)
