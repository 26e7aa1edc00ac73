"""STATUSTEXT: texts for the operator, split into chunks when they are long."""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.mavlink.codec import WireMessage, dialect

CHUNK_BYTES = 50
_LAST_ID = 65_535

SAID_BY_EVENT = b"\t"
"""Ends a text that is an event, too, as PX4's do: ground stations that know events pass it over."""

REPLY_IDS = 32_768
"""First id of answers that are counted apart from the autopilot's texts: the ids of two consecutive
long texts must differ."""


class TextEncoder:
    """Turns texts into STATUSTEXT messages, with the ids that tie the chunks together."""

    def __init__(self, last_id: int = 0) -> None:
        """Give the first long text the id after `last_id`."""
        self._id = last_id

    def encode(self, message: Message) -> list[WireMessage]:
        """Return the messages of one text, in order.

        A text of up to 50 characters is one message with id 0. A longer one is chunks with one id.
        A chunk with a NUL in it is the last, so a text that fills its last chunk to the brim is
        followed by an empty one.
        """
        text = message.text.encode("ascii", errors="replace")
        if message.event is not None:
            text += SAID_BY_EVENT
        if len(text) <= CHUNK_BYTES:
            return [dialect.MAVLink_statustext_message(message.severity, text)]
        self._id = self._id % _LAST_ID + 1
        starts = range(0, len(text) + 1, CHUNK_BYTES)
        return [
            dialect.MAVLink_statustext_message(
                message.severity, text[start : start + CHUNK_BYTES], self._id, chunk
            )
            for chunk, start in enumerate(starts)
        ]
