"""The links of PX4 SITL: default rates of their streams, and their UDP ports.

Onboard API, ground station and gimbal. The rates are measured on a real PX4 1.16 SITL. The
tables omit OPEN_DRONE_ID_*, EVENT and CURRENT_EVENT_SEQUENCE (see `texts_and_events`), and
LINK_NODE_STATUS, whose counts depend on client timing and would change a flight's telemetry.
Messages due in the same tick are sent in table order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

from firmware_sim import sensor_table
from firmware_sim.mavlink.endpoint import (
    Address,
    Endpoint,
    PortTakenError,
    SharedEndpoint,
    UdpEndpoint,
)


def _table(*rows: tuple[Any, ...]) -> Mapping[str, float]:
    """Return the rates of rows that hold a rate [Hz] and the names of consecutive streams."""
    return MappingProxyType({name: hz for hz, *names in rows for name in names})


ONBOARD_HZ = _table(
    (1.0, "HEARTBEAT"),
    (10.0, "TIMESYNC"),
    (100.0, "ATTITUDE"),
    (50.0, "ATTITUDE_QUATERNION"),
    (30.0, "LOCAL_POSITION_NED", "ODOMETRY"),
    (50.0, "GLOBAL_POSITION_INT", "HIGHRES_IMU"),
    (
        10.0,
        "ALTITUDE",
        "ATTITUDE_TARGET",
        "POSITION_TARGET_LOCAL_NED",
        "POSITION_TARGET_GLOBAL_INT",
        "SERVO_OUTPUT_RAW",
        "VFR_HUD",
        "GPS_RAW_INT",
    ),
    (5.0, "EXTENDED_SYS_STATE", "SYS_STATUS"),
    (1.0, "ESTIMATOR_STATUS", "PING", "SCALED_PRESSURE", "SYSTEM_TIME", "MISSION_CURRENT"),
    (
        0.5,
        "BATTERY_STATUS",
        "HOME_POSITION",
        "VIBRATION",
        "CURRENT_MODE",
        "TIME_ESTIMATE_TO_TARGET",
    ),
    (5.0, "ORBIT_EXECUTION_STATUS"),
    (10.0, "ESC_INFO", "ESC_STATUS"),
    (20.0, "RC_CHANNELS"),
    (10.0, "DISTANCE_SENSOR", "OPTICAL_FLOW_RAD"),
)
"""Onboard (API) link, 14580 -> 14540 [Hz]."""

GCS_HZ = _table(
    (1.0, "HEARTBEAT"),
    (
        50.0,
        "ATTITUDE",
        "ATTITUDE_QUATERNION",
        "LOCAL_POSITION_NED",
        "GLOBAL_POSITION_INT",
        "ATTITUDE_TARGET",
        "POSITION_TARGET_LOCAL_NED",
    ),
    (1.0, "POSITION_TARGET_GLOBAL_INT"),
    (50.0, "SERVO_OUTPUT_RAW"),
    (5.0, "GPS_RAW_INT"),
    (4.0, "VFR_HUD"),
    (1.0, "ALTITUDE", "EXTENDED_SYS_STATE", "SCALED_PRESSURE", "SYS_STATUS", "MISSION_CURRENT"),
    (0.5, "BATTERY_STATUS", "ESTIMATOR_STATUS", "HOME_POSITION"),
    (0.1, "PING", "VIBRATION"),
    (0.5, "CURRENT_MODE", "TIME_ESTIMATE_TO_TARGET"),
    (5.0, "ORBIT_EXECUTION_STATUS"),
    (1.0, "ESC_INFO", "ESC_STATUS"),
    (5.0, "RC_CHANNELS"),
    (0.5, "DISTANCE_SENSOR"),
    (1.0, "OPTICAL_FLOW_RAD"),
)
"""Ground station link, 18570 -> 14550 [Hz]."""

GIMBAL_HZ: Mapping[str, float] = MappingProxyType(
    {"HEARTBEAT": 1.0, "AUTOPILOT_STATE_FOR_GIMBAL_DEVICE": 20.0, "MISSION_CURRENT": 1.0}
)
"""Gimbal link, 13030 -> 13280 [Hz]."""


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """Configuration of a link: endpoint and streams."""

    name: str
    endpoint: SharedEndpoint
    rates_hz: Mapping[str, float]
    """Default rate per stream [Hz]; other streams are off."""
    separate_replies: bool = False
    """True if replies to requests have separate sequence numbers, which keeps the telemetry bytes
    independent of the times of requests. Requires a peer that does not count a jump in the sequence
    as lost messages."""
    slow_every_us: int = 0
    """Interval of the streams not packed in compiled code [µs], in simulated time from the first
    tick. Keeps streams independent of the number of ticks per call. 0 = any tick."""


def _rates(px4: Mapping[str, float], link: str) -> Mapping[str, float]:
    """Return the default rates [Hz] of PX4's streams and of further sensors."""
    further = {name: getattr(each, link) for name, each in sensor_table.streams().items()}
    return {**px4, **{name: hz for name, hz in further.items() if name not in px4 and hz > 0.0}}


def onboard_link(endpoint: SharedEndpoint, *, separate_replies: bool = False) -> LinkConfig:
    """Return the configuration of the companion's link (PX4: 14580 -> 14540)."""
    return LinkConfig("onboard", endpoint, _rates(ONBOARD_HZ, "onboard_hz"), separate_replies)


def gcs_link(endpoint: SharedEndpoint, *, separate_replies: bool = False) -> LinkConfig:
    """Return the configuration of a ground station's link (PX4: 18570 -> 14550)."""
    return LinkConfig("gcs", endpoint, _rates(GCS_HZ, "gcs_hz"), separate_replies)


def gimbal_link(endpoint: SharedEndpoint) -> LinkConfig:
    """Return the configuration of a gimbal's link (PX4: 13030 -> 13280)."""
    return LinkConfig("gimbal", endpoint, GIMBAL_HZ)


class UdpLinks(NamedTuple):
    """Endpoints of the vehicle's two main links."""

    api: UdpEndpoint
    gcs: UdpEndpoint

    def by_name(self) -> dict[str, Endpoint]:
        """Return the endpoints by link name."""
        return {"onboard": self.api, "gcs": self.gcs}


def bind_udp_links(
    *,
    bind: str,
    api_remote: Address,
    api_local_port: int,
    gcs_remote: Address,
    gcs_local_port: int,
    insecure: bool,
) -> UdpLinks:
    """Bind the vehicle's ports of both links.

    Raises:
        UsageError: A port is in use, or an address is reachable from other machines without
            `insecure`.
    """
    ends: list[UdpEndpoint] = []
    for name, port, remote in (
        ("api", api_local_port, api_remote),
        ("gcs", gcs_local_port, gcs_remote),
    ):
        options = f"--{name}-local-port", f"--{name}-port"
        try:
            ends.append(UdpEndpoint((bind, port), remote, *options, insecure=insecure))
        except Exception:
            for end in ends:
                end.close()
            raise
    return UdpLinks(*ends)


GIMBAL_PORTS = 13030, 13280
"""Local and remote port of PX4 SITL's link to a gimbal, for instance 0."""


def bind_gimbal_link(
    bind: str, remote_host: str, instance: int, *, insecure: bool, say: Callable[[str], None]
) -> list[LinkConfig]:
    """Bind the vehicle's port of the gimbal link; a port in use is skipped and reported.

    Raises:
        UsageError: An address is reachable from other machines without `insecure`.
    """
    # As in PX4 SITL, each instance shifts all ports by its number.
    local, remote = (port + instance for port in GIMBAL_PORTS)
    ends = (bind, local), (remote_host, remote)
    try:
        end = UdpEndpoint(*ends, "--instance", "--instance", insecure=insecure)
    except PortTakenError:
        # Two vehicles may share a host on custom ports.
        say(f"UDP port {local} is taken: no gimbal link")
        return []
    say(f"{'gimbal':<17} UDP port {remote} (from {local})")
    return [gimbal_link(end)]
