"""Vehicles put anywhere, for their cameras."""

from __future__ import annotations

from airl_mav.envs.fleet import Seen, new_fleet


def at_rest(n: int) -> Seen:
    """Return n vehicles in the origin, as kernels that render take those of an environment."""
    fleet = new_fleet(n)
    return Seen(*(getattr(fleet, name) for name in Seen._fields))
