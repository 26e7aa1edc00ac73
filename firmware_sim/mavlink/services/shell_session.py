"""One client's part in the shell: what was typed, and what is still to be sent."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class Shell:
    """One client's shell."""

    line: bytearray = field(default_factory=bytearray)
    """What was typed of a line that has not ended."""
    output: bytearray = field(default_factory=bytearray)
    """What is still to be sent."""
