"""What can go wrong while somebody conducts."""

from __future__ import annotations


class LockstepError(Exception):
    """The companion does not keep to the turns; the message says how."""
