"""Words for things that airl-mav does not have: errors about them refer to a page."""

from __future__ import annotations

import re
from collections.abc import Iterable

PAGE = "docs/not-supported.md"
"""Page about everything that airl-mav does not do."""

_WORDS = re.compile(
    "(?:num-)?(?:drones|vehicles)|swarm"
    "|(?:arduplane|ardurover|ardusub|betaflight|inav)"
    "|(?:gazebo|gz)(?:[-_].*)?|airsim|flightgear|isaac|isaac-sim|jmavsim|jsbsim|simulink|webots"
    "|(?:hexa|octo|tri)(?:copter|rotor)?|boat|fixed[-_]?wing|helicopter|plane|rover|tailsitter|vtol",
    re.IGNORECASE,
)
"""Words of a command line that ask for an unsupported vehicle, firmware or simulator."""


def refer(words: Iterable[str]) -> str | None:
    """Return a reference to the page for the first such word of a rejected command line."""
    for word in words:
        for part in word.lstrip("-").split("=", 1):
            if _WORDS.fullmatch(part):
                return f"{part} is unsupported: see {PAGE}"
    return None
