"""Measured flights in lockstep beside a foreign system on the companion's link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from airl_mav.flight.episode_record import EpisodeRecord
from airl_mav.flight.judge import Referee
from airl_mav.lockstep.lockstep_flight import LockstepFlight, fly
from firmware_sim.mavlink.codec import dialect
from firmware_sim.simulation import Simulation
from tests.support.foreign_messages import CHANGED, FOREIGN, ftp
from tests.support.lockstep_kit import SEED, demo_scenario
from tests.support.mavlink_clients import RawClient

OBSERVED: list[Any] = [
    dialect.MAVLink_heartbeat_message(6, 8, 192, 0, 4, 3),
    dialect.MAVLink_ping_message(1, 1, 0, 0),
    dialect.MAVLink_param_request_list_message(1, 1),
    dialect.MAVLink_param_request_read_message(1, 1, b"_HASH_CHECK", -1),
    *(dialect.MAVLink_mission_request_list_message(1, 1, kind) for kind in range(3)),
    *(dialect.MAVLink_mission_ack_message(1, 1, 0, kind) for kind in range(3)),
    dialect.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF),
    dialect.MAVLink_request_event_message(1, 1, 0, 3),
    *(
        dialect.MAVLink_command_long_message(1, 1, 512, 0, float(number), 0, 0, 0, 0, 0, 0)
        for number in (148, 300, 397, 435)
    ),
    *(ftp(opcode, b"/etc/extras/component_general.json.xz") for opcode in (2, 4, 3)),
]
"""Requests of a ground station that only watches."""


def flown_beside(messages: Sequence[Any], ids: tuple[int, int]) -> EpisodeRecord:
    """Fly with the messages of another system, all sent at the start of navigation."""
    waiting = list(messages)

    def meddle(_simulation: Simulation, referee: Referee, _hit: str | None) -> None:
        if referee.navigation_us is not None and waiting:
            stack: Any = flight._stage.firmware.flight_stack
            (onboard,) = stack._server._links
            client = RawClient(onboard.endpoint, ids)
            while waiting:
                client.send(waiting.pop(0))

    scenario = demo_scenario(start="hover")
    flight = LockstepFlight(scenario, scenario.fresh_policy(SEED), 0, SEED, ticked=meddle)
    record = flight.fly().record
    assert not waiting
    return record


def test_a_foreign_system_makes_the_flight_invalid_by_every_message() -> None:
    beats = [dialect.MAVLink_heartbeat_message(kind, 8, 0, 0, 0, 3) for kind in (6, 18)]
    foreign = [message for messages in FOREIGN.values() for message in messages]
    record = flown_beside([*foreign, *CHANGED.values(), *beats], (77, 1))
    for name in (*FOREIGN, *CHANGED):
        named = f"commanded by a stranger: onboard, system 77 component 1, {name}"
        assert any(line.startswith(named) for line in record.invalid), name
    limited = next(line for line in record.invalid if "MPC_XY_VEL_MAX" in line)
    assert " from 12 to 6.5 (once, first " in limited
    assert record.sha256 is None
    assert all(record.started_us <= effect.first_us for effect in record.effects)


@pytest.mark.parametrize("ids", [(255, 190), (77, 1)])
def test_a_system_that_only_watches_leaves_the_flight_valid(ids: tuple[int, int]) -> None:
    scenario = demo_scenario(start="hover")
    alone = fly(scenario, scenario.fresh_policy(SEED), 0, SEED).record
    watched = flown_beside(OBSERVED, ids)
    # The digest of telemetry includes the answers to the requests.
    assert replace(watched, sha256=None) == replace(alone, sha256=None)
    digests = [{**(each.sha256 or {}), "telemetry": "", "flight": ""} for each in (watched, alone)]
    assert digests[0] == digests[1] != {}
    assert watched.invalid == ()
    assert watched.effects
    assert all(effect.is_companion for effect in watched.effects)
