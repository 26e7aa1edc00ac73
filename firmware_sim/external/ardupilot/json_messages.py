"""ArduPilot's JSON simulator interface as bytes: servo packets in, state lines out. Pure.

Source: ArduPilot libraries/SITL/SIM_JSON.h and .cpp, checked against a running ArduCopter 4.7.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from airl_mav.core.constants import US_PER_S
from firmware_sim.interfaces import SensorSample, Truth

MAGIC_16, MAGIC_32 = 18_458, 29_569
"""First word of a packet of 16 servo channels, and of 32 (SERVO_32_ENABLE = 1)."""

_PACKETS = {40: (MAGIC_16, struct.Struct("<HHI16H")), 72: (MAGIC_32, struct.Struct("<HHI32H"))}
"""Length of a packet [bytes]: its magic and its layout."""


class ServoPacketError(ValueError):
    """A datagram is not a servo packet; the message says why."""


class ServoPacket(NamedTuple):
    """What ArduPilot sends once per frame."""

    frame_rate_hz: int
    """Frames a second of simulated time that it asks for (SIM_RATE_HZ)."""
    frame_count: int
    """State lines that it has received since it started."""
    pwm_us: tuple[int, ...]
    """Servo outputs 1..16 or 1..32 [µs]; 0 = none."""


def parse_servos(datagram: bytes) -> ServoPacket:
    """Parse a servo packet. Raises ServoPacketError if the datagram is not one."""
    packet = _PACKETS.get(len(datagram))
    if packet is None:
        lengths = " or ".join(str(length) for length in _PACKETS)
        raise ServoPacketError(f"{len(datagram)} bytes: a servo packet has {lengths}")
    magic, layout = packet
    found, rate, count, *pwm = layout.unpack(datagram)
    if found != magic:
        raise ServoPacketError(f"magic {found}: a packet of {len(datagram)} bytes has {magic}")
    return ServoPacket(rate, count, tuple(pwm))


AWAY_FROM_ZERO = 1.0 + 1e-8
"""ArduPilot cuts the difference of two times to whole microseconds: 832.9999 of 833 would lose a
thousandth of its time."""


def state_line(time_us: int, sample: SensorSample, truth: Truth) -> bytes:
    """Return the answer to a servo packet: one line, a line feed before and after.

    ArduPilot finds keys by substring and then reads with sscanf: nothing may stand between a key's
    colon and its bracket, and no key may hold the name of a later one. Numbers are the shortest
    that read back as the same double.

    Args:
        time_us: Physics time on a base of the sender's own, > 0 [µs].
        sample: What the inertial sensors measure, FRD.
        truth: The true state: ArduPilot simulates GPS, barometer and compass from it.
    """
    return (
        f'\n{{"timestamp":{time_us * AWAY_FROM_ZERO / US_PER_S!r},'
        f'"imu":{{"gyro":{sample.gyro.tolist()},"accel_body":{sample.accel.tolist()}}},'
        f'"position":{truth.position.tolist()},'
        f'"quaternion":{truth.quaternion.tolist()},'
        f'"velocity":{truth.velocity.tolist()},'
        # Otherwise it would pace itself by the wall clock; here the plant sets the pace.
        f'"no_time_sync":1}}\n'
    ).encode("ascii")
