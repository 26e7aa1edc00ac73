"""The UDP links of PX4 SITL: onboard API, ground station, payload and gimbal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from airl_mav.core.clock import Clock
from airl_mav.core.signing import StoredSigning
from firmware_sim.mavlink.endpoint import (
    Address,
    Endpoint,
    PortTakenError,
    SharedEndpoint,
    UdpEndpoint,
)
from firmware_sim.mavlink.link import (
    LinkConfig,
    gcs_link,
    gimbal_link,
    onboard_link,
    payload_link,
)
from firmware_sim.mavlink.server import MavlinkServer


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


def udp_server(
    ends: UdpLinks,
    boot_unix_us: int,
    clock: Clock,
    signing: StoredSigning | None = None,
    *,
    onboard: SharedEndpoint | None = None,
    devices: Sequence[LinkConfig] = (),
) -> MavlinkServer:
    """Return the server of all links, without an autopilot; see `MavlinkServer`.

    `onboard` wraps and replaces the endpoint of the onboard link; None = use it directly.
    """
    links = [onboard_link(onboard or ends.api), gcs_link(ends.gcs), *devices]
    return MavlinkServer(links, boot_unix_us=boot_unix_us, clock=clock, signing=signing)
