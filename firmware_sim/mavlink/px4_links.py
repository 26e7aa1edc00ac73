"""The two links of PX4 SITL: onboard API and ground station, both over UDP."""

from __future__ import annotations

from firmware_sim.mavlink.endpoint import Address, UdpEndpoint
from firmware_sim.mavlink.link import gcs_link, onboard_link
from firmware_sim.mavlink.server import MavlinkServer


def px4_server(
    *,
    bind: str,
    api_remote: Address,
    api_local_port: int,
    gcs_remote: Address,
    gcs_local_port: int,
    insecure: bool,
    boot_unix_us: int,
) -> MavlinkServer:
    """Bind both links and return the server, still without an autopilot.

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
    return MavlinkServer([onboard_link(api), gcs_link(gcs)], boot_unix_us=boot_unix_us)
