"""The links of PX4 SITL: default rates of their streams, and their UDP ports.

Onboard API, ground station, payload and gimbal. The rates are measured on a real PX4 1.16 SITL. The
tables omit OPEN_DRONE_ID_*, EVENT and CURRENT_EVENT_SEQUENCE (see `texts_and_events`), and
LINK_NODE_STATUS, whose counts depend on client timing and would change a flight's telemetry.
Messages due in the same tick are sent in table order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from firmware_sim import sensor_table
from firmware_sim.mavlink.endpoint import (
    Address,
    Endpoint,
    PortTakenError,
    SharedEndpoint,
    UdpEndpoint,
)

ONBOARD_HZ: Mapping[str, float] = MappingProxyType(
    {
        "HEARTBEAT": 1.0,
        "TIMESYNC": 10.0,
        "ATTITUDE": 100.0,
        "ATTITUDE_QUATERNION": 50.0,
        "LOCAL_POSITION_NED": 30.0,
        "ODOMETRY": 30.0,
        "GLOBAL_POSITION_INT": 50.0,
        "HIGHRES_IMU": 50.0,
        "ALTITUDE": 10.0,
        "ATTITUDE_TARGET": 10.0,
        "POSITION_TARGET_LOCAL_NED": 10.0,
        "POSITION_TARGET_GLOBAL_INT": 10.0,
        "SERVO_OUTPUT_RAW": 10.0,
        "VFR_HUD": 10.0,
        "GPS_RAW_INT": 10.0,
        "EXTENDED_SYS_STATE": 5.0,
        "SYS_STATUS": 5.0,
        "ESTIMATOR_STATUS": 1.0,
        "PING": 1.0,
        "SCALED_PRESSURE": 1.0,
        "SYSTEM_TIME": 1.0,
        "MISSION_CURRENT": 1.0,
        "BATTERY_STATUS": 0.5,
        "HOME_POSITION": 0.5,
        "VIBRATION": 0.5,
        "CURRENT_MODE": 0.5,
        "TIME_ESTIMATE_TO_TARGET": 0.5,
        "ORBIT_EXECUTION_STATUS": 5.0,
        "ESC_INFO": 10.0,
        "ESC_STATUS": 10.0,
        "RC_CHANNELS": 20.0,
        "DISTANCE_SENSOR": 10.0,
        "OPTICAL_FLOW_RAD": 10.0,
    }
)
"""Onboard (API) link, 14580 -> 14540 [Hz]."""

GCS_HZ: Mapping[str, float] = MappingProxyType(
    {
        "HEARTBEAT": 1.0,
        "ATTITUDE": 50.0,
        "ATTITUDE_QUATERNION": 50.0,
        "LOCAL_POSITION_NED": 50.0,
        "GLOBAL_POSITION_INT": 50.0,
        "ATTITUDE_TARGET": 50.0,
        "POSITION_TARGET_LOCAL_NED": 50.0,
        "POSITION_TARGET_GLOBAL_INT": 1.0,
        "SERVO_OUTPUT_RAW": 50.0,
        "GPS_RAW_INT": 5.0,
        "VFR_HUD": 4.0,
        "ALTITUDE": 1.0,
        "EXTENDED_SYS_STATE": 1.0,
        "SCALED_PRESSURE": 1.0,
        "SYS_STATUS": 1.0,
        "MISSION_CURRENT": 1.0,
        "BATTERY_STATUS": 0.5,
        "ESTIMATOR_STATUS": 0.5,
        "HOME_POSITION": 0.5,
        "PING": 0.1,
        "VIBRATION": 0.1,
        "CURRENT_MODE": 0.5,
        "TIME_ESTIMATE_TO_TARGET": 0.5,
        "ORBIT_EXECUTION_STATUS": 5.0,
        "ESC_INFO": 1.0,
        "ESC_STATUS": 1.0,
        "RC_CHANNELS": 5.0,
        "DISTANCE_SENSOR": 0.5,
        "OPTICAL_FLOW_RAD": 1.0,
    }
)
"""Ground station link, 18570 -> 14550 [Hz]."""

PAYLOAD_RATE = 0.1432
"""Rate factor of the payload link, measured. PX4 limits this link to 4,000 bytes/s and slows all
its streams down."""

PAYLOAD_HZ: Mapping[str, float] = MappingProxyType(
    {
        name: hz if name in ("HEARTBEAT", "PING", "MISSION_CURRENT", "GPS_RAW_INT") else slowed
        for name, hz, slowed in ((name, hz, hz * PAYLOAD_RATE) for name, hz in ONBOARD_HZ.items())
    }
)
"""Payload link, 14280 -> 14030 [Hz]: PX4's onboard mode at reduced rates."""

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


def payload_link(endpoint: SharedEndpoint) -> LinkConfig:
    """Return the configuration of a link to a camera or another payload (PX4: 14280 -> 14030)."""
    return LinkConfig("payload", endpoint, PAYLOAD_HZ)


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
    api = UdpEndpoint(
        (bind, api_local_port),
        api_remote,
        local_option="--api-local-port",
        remote_option="--api-port",
        insecure=insecure,
    )
    try:
        gcs = UdpEndpoint(
            (bind, gcs_local_port),
            gcs_remote,
            local_option="--gcs-local-port",
            remote_option="--gcs-port",
            insecure=insecure,
        )
    except Exception:
        api.close()
        raise
    return UdpLinks(api, gcs)


DEVICE_PORTS = {payload_link: (14280, 14030), gimbal_link: (13030, 13280)}
"""Local and remote port of PX4 SITL's links to onboard devices, for instance 0."""


def bind_device_links(
    bind: str, remote_host: str, instance: int, *, insecure: bool, say: Callable[[str], None]
) -> list[LinkConfig]:
    """Bind the vehicle's ports of the payload link and the gimbal link.

    A port in use is skipped and reported: few vehicles have a payload or a gimbal, and two vehicles
    may share a host on custom ports.

    Raises:
        UsageError: An address is reachable from other machines without `insecure`.
    """
    links: list[LinkConfig] = []
    for link, ports in DEVICE_PORTS.items():
        # As in PX4 SITL, each instance shifts all ports by its number.
        local, remote = (port + instance for port in ports)
        try:
            end = UdpEndpoint(
                (bind, local),
                (remote_host, remote),
                local_option="--instance",
                remote_option="--instance",
                insecure=insecure,
            )
        except PortTakenError:
            say(f"UDP port {local} is taken: no {link.__name__.replace('_', ' ')}")
            continue
        except Exception:
            # A usage error ends the program: release the ports bound so far.
            for bound in links:
                bound.endpoint.close()
            raise
        links.append(link(end))
        say(f"{links[-1].name:<17} UDP port {remote} (from {local})")
    return links
