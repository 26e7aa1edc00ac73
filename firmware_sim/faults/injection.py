"""Faults that a client injects in flight."""

from __future__ import annotations

from collections.abc import Callable

from airl_mav.faults.kinds import Part
from airl_mav.faults.model import Fault
from firmware_sim.faults.timeline import FaultTimeline


class ClientFaults:
    """Puts what clients inject among the faults of an episode. Implements `port.Failures`."""

    def __init__(self, timeline: Callable[[], FaultTimeline]) -> None:
        """Take what returns the faults of the episode, at the present time.

        It is asked first when something is injected. Until then nothing lies between the plant and
        the flight controller.
        """
        self._timeline = timeline
        self._injected = False

    def inject(self, fault: Fault) -> None:
        """Let a part fail from now on."""
        self._injected = True
        self._timeline().inject(fault)

    def clear(self, part: Part) -> None:
        """End all that acts on a part."""
        if self._injected:
            self._timeline().clear(part)
