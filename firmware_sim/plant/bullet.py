"""pybullet, imported and connected without its banner."""

from __future__ import annotations

from typing import Any

from firmware_sim.quiet import quiet_terminal

with quiet_terminal():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

__all__ = ["connect", "pybullet"]


def connect() -> Any:
    """Return a client of a new physics server in this process."""
    with quiet_terminal():
        return BulletClient(pybullet.DIRECT)
