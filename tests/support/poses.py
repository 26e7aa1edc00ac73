"""Vehicles put anywhere, for their cameras."""

from __future__ import annotations

from airl_mav.envs.fleet import FramePoses, new_fleet


def at_rest(n: int) -> FramePoses:
    """Return n vehicles in the origin, as kernels that render take those of an environment."""
    fleet = new_fleet(n)
    return FramePoses(*(getattr(fleet, name) for name in FramePoses._fields))
