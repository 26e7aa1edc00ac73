"""The two UDP links of PX4 SITL: onboard API and ground station."""

from __future__ import annotations

from typing import NamedTuple

from airl_mav.core.clock import Clock
from airl_mav.core.signing_key import StoredSigning
from firmware_sim.mavlink.endpoint import Address, Endpoint, SharedEndpoint, UdpEndpoint
from firmware_sim.mavlink.link import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer


class UdpLinks(NamedTuple):
    """The vehicle's ends of both links."""

    api: UdpEndpoint
    gcs: UdpEndpoint

    def by_name(self) -> dict[str, Endpoint]:
        """Return the ends by the names of their links."""
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
        UsageError: A port is taken, or an address can be reached from other machines without
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


def udp_server(
    ends: UdpLinks,
    boot_unix_us: int,
    clock: Clock,
    signing: StoredSigning | None = None,
    *,
    onboard: SharedEndpoint | None = None,
) -> MavlinkServer:
    """Return the server of both links, still without an autopilot; see `MavlinkServer`.

    `onboard` stands in for the end of the onboard link, which it wraps; None: the end itself.
    """
    links = [onboard_link(onboard or ends.api), gcs_link(ends.gcs)]
    return MavlinkServer(links, boot_unix_us=boot_unix_us, clock=clock, signing=signing)
