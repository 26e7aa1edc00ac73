"""How a vehicle answers velocity setpoints: a first-order model, in closed form.

After a dead time the velocity approaches the setpoint with one time constant, the yaw rate with
another; a setpoint in the heading frame turns with the nose, as PX4 turns it at every repetition.
Not the plant's equations: what `scripts/fit-response` finds from flown steps alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.constants import GRAVITY_M_S2
from airl_mav.profiles.vehicle import Response

Array = NDArray[np.float64]


class Motion(NamedTuple):
    """How n vehicles move."""

    position: Array  # (n, 3) NED [m]
    velocity: Array  # (n, 3) NED [m/s]
    heading: Array  # (n,) [rad]
    heading_rate: Array  # (n,) [rad/s]


def flown_on(motion: Motion, command: Array, response: Response, seconds: Array) -> Motion:
    """Return the motion of vehicles after (n,) seconds on one setpoint (n, 4) each.

    With the heading turning at the rate w from psi on, the horizontal velocity v as a complex
    number (north + i east) follows T v' = c exp(i (psi + w t)) - v, whose solution is A exp(i w t)
    + (v0 - A) exp(-t / T) with A = c exp(i psi) / (1 + i w T). While the turn itself still builds
    up, psi is that of the turn it ends in. The setpoint is forward, right, down [m/s], yaw rate
    [rad/s]. The response's dead time is left to the caller.
    """
    turn, lag, turn_lag = command[:, 3], response.velocity_time_s, response.yaw_rate_time_s
    fading, turn_fading = np.exp(-seconds / lag), np.exp(-seconds / turn_lag)
    lead = (motion.heading_rate - turn) * turn_lag
    turned = turn * seconds
    wanted = (command[:, 0] + 1j * command[:, 1]) * np.exp(1j * (motion.heading + lead))
    follows = wanted / (1.0 + 1j * lag * turn)
    velocity = motion.velocity[:, 0] + 1j * motion.velocity[:, 1] - follows
    # The integral of exp(i w t); sinc has no trouble where w is zero.
    arc = seconds * np.sinc(turned / (2.0 * math.pi)) * np.exp(0.5j * turned)
    moved = follows * arc + velocity * (lag * (1.0 - fading))
    velocity = follows * np.exp(1j * turned) + velocity * fading
    sinking = motion.velocity[:, 2] - command[:, 2]
    sunk = command[:, 2] * seconds + sinking * (lag * (1.0 - fading))
    return Motion(
        motion.position + np.stack([moved.real, moved.imag, sunk], axis=1),
        np.stack([velocity.real, velocity.imag, command[:, 2] + sinking * fading], axis=1),
        motion.heading + turned + lead * (1.0 - turn_fading),
        turn + (motion.heading_rate - turn) * turn_fading,
    )


def leaning(motion: Motion, command: Array, response: Response) -> tuple[Array, Array]:
    """Return the roll and pitch (n,) [rad] with which the vehicles fly on a setpoint (n, 4).

    The thrust carries the weight and gives the acceleration and what the drag takes, so that it is
    along the sum of the three.
    """
    course = np.exp(-1j * motion.heading)
    velocity = (motion.velocity[:, 0] + 1j * motion.velocity[:, 1]) * course
    wanted = command[:, 0] + 1j * command[:, 1]
    push = (wanted - velocity) / response.velocity_time_s + response.drag_1_s * velocity
    pitch = -np.arctan2(push.real, GRAVITY_M_S2)
    return np.arctan2(push.imag * np.cos(pitch), GRAVITY_M_S2), pitch
