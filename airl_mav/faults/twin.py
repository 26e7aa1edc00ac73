"""What of the faults the batch twin can fly; its flights begin where the policy takes over."""

from __future__ import annotations

from collections.abc import Sequence

from airl_mav.core.errors import FieldError
from airl_mav.faults.model import Fault

TWIN = "gym"
"""The batch twin's rung of the fidelity ladder."""


def check_twin(faults: Sequence[Fault], *, pipelined: bool = False) -> None:
    """Raise FieldError for a fault that the twin cannot fly.

    With pipelined decisions, delays beyond the next decision are not modelled.
    """
    for fault in faults:
        levels = fault.about.levels
        if TWIN not in levels:
            raise FieldError("faults", str(fault), f"at level {' or '.join(levels)}")
        if not _in_flight(fault):
            raise FieldError("faults", str(fault), "at offboard, or offboard+TIME, at level gym")
        if pipelined and fault.kind == "delay":
            accepted = "with decisions sequential, or at level lockstep or sitl"
            raise FieldError("faults", str(fault), accepted)
    late = [fault for fault in faults if (fault.part, fault.kind) == ("camera", "delay")]
    if len(late) > 1:
        raise FieldError("faults", str(late[1]), "one delay of the camera at level gym")


def _in_flight(fault: Fault) -> bool:
    """Return whether it begins in the flight, or has acted since before it.

    What ends before the policy takes over was never there. Neither was the picture of the ground.
    """
    from_the_start = fault.phase is None and not fault.at_s and fault.for_s is None
    return fault.phase == "offboard" or (from_the_start and fault.kind != "stuck")
