"""From one mission item to the next: DO_JUMP, and where the mission leads.

Source: PX4 1.16, MissionBase::getNonJumpItem, getNextPositionItems.
"""

from __future__ import annotations

from firmware_sim.autopilot.navigation.plan import NavCommand, PlanItem, Plans

MOST_JUMPS = 10
"""After so many jumps in a row the search ends at a jump (PX4's MAX_JUMP_ITERATION)."""


def resolve(plans: Plans, index: int, *, count: bool) -> int | None:
    """Return the index of the item that is flown instead of a DO_JUMP; others are themselves.

    Args:
        plans: The mission, and how often its jumps have been carried out.
        index: Where to begin.
        count: Whether jumps count as carried out.

    Returns:
        None where the mission ends, or where a jump leads out of it.
    """
    items = plans.mission
    for _ in range(MOST_JUMPS):
        if not 0 <= index < len(items):
            return None
        item = items[index]
        if item.command != NavCommand.DO_JUMP:
            return index
        target, repeats = _whole(item.params[0]), _whole(item.params[1])
        if not 0 <= target < len(items):
            return None
        done = plans.jumps_done.get(index, 0)
        if done < repeats:
            if count:
                plans.jumps_done[index] = done + 1
                plans.jumped = index
            index = target
        else:
            index += 1
    return index if 0 <= index < len(items) else None


def go_to(plans: Plans, index: int) -> int | None:
    """Return the item to fly for an index, and count the jumps to it; None = there is none."""
    return resolve(plans, index, count=True)


def next_places(plans: Plans, index: int, most: int) -> list[PlanItem]:
    """Return the next items with a place from an index on, at most so many."""
    found: list[PlanItem] = []
    # Each item is looked at once, so that a jump back and forth ends.
    for _ in range(2 * len(plans.mission)):
        if len(found) == most:
            break
        following = resolve(plans, index, count=False)
        if following is None:
            break
        if plans.mission[following].has_position:
            found.append(plans.mission[following])
        index = following + 1
    return found


def _whole(value: float) -> int:
    """Return a number of the wire as PX4 does, towards zero; what is none is -1."""
    return int(value) if abs(value) < 65_536.0 else -1
