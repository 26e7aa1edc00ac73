"""pybullet, imported and connected without its banner.

A BulletClient looks every function up and wraps it at every call, which costs more than most of
the functions: what runs at every tick calls `pybullet` itself with the client's number.
"""

from __future__ import annotations

from typing import Any

from firmware_sim.plant.silenced_output import silenced_output

with silenced_output():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

__all__ = ["NO_CLIENT", "connect", "number_of", "pybullet"]

NO_CLIENT = -1
"""Number of a client that has been closed: every call with it raises pybullet.error."""


def connect() -> Any:
    """Return a client of a new physics server in this process."""
    with silenced_output():
        return BulletClient(pybullet.DIRECT)


def number_of(client: Any) -> int:
    """Return what pybullet's functions call a client: their `physicsClientId`."""
    return int(client._client)
