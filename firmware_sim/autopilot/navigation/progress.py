"""Mission progress of the plans."""

from __future__ import annotations

from firmware_sim.autopilot.autopilot_state import NO_MISSION, MissionProgress
from firmware_sim.autopilot.navigation.plan import Kind, Plans


def progress(plans: Plans) -> MissionProgress:
    """Return the mission progress and the ids of the stored lists."""
    mission, fence, rally = (plans.stored(kind) for kind in Kind)
    if not (mission.items or fence.items or rally.items):
        return NO_MISSION
    return MissionProgress(
        plans.current, len(mission.items), mission.identity, fence.identity, rally.identity
    )
