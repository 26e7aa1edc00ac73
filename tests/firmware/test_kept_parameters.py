"""Parameters that outlive the flight controller, and PREFLIGHT_STORAGE."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from airl_mav.core.errors import FieldError, UsageError
from airl_mav.scenario.aircraft import RealFirmware
from airl_mav.scenario.stand_alone import StandAloneVehicle, check_vehicle
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.external.parameters import KeptParameters
from firmware_sim.firmware import BuiltinFlightStack, Firmware
from firmware_sim.mavlink.codec import dialect
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.pacing import Unpaced
from firmware_sim.simulation import EpisodeSetup
from tests.support.flight_rig import quad
from tests.support.mavlink_clients import RawClient

PREFLIGHT_STORAGE = 245
LOAD, SAVE, RESET = 0, 1, 2
ACCEPTED, REJECTED, FAILED = 0, 1, 4


class Flown:
    """The built-in flight controller with a client, and a file of parameters."""

    def __init__(self, firmware: Firmware, client: RawClient) -> None:
        self._firmware, self.client = firmware, client

    def run(self, ticks: int) -> None:
        for _ in range(ticks):
            self._firmware.step()

    def set(self, name: str, value: float) -> None:
        self.client.send(dialect.MAVLink_param_set_message(1, 1, name.encode(), value, 9))
        self.run(2)

    def get(self, name: str) -> float:
        self.client.received()
        self.client.send(dialect.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
        self.run(2)
        (answer,) = self.client.received("PARAM_VALUE")
        return float(answer.param_value)

    def command(self, number: int, *params: float) -> list[int]:
        self.client.received()
        self.client.command(number, *params)
        self.run(2)
        return [ack.result for ack in self.client.received("COMMAND_ACK")]


@contextmanager
def flown(path: Path) -> Iterator[Flown]:
    endpoint = MemoryEndpoint()
    server = MavlinkServer([onboard_link(endpoint)], boot_unix_us=0)
    stack = BuiltinFlightStack(server, KeptParameters(path))
    firmware = Firmware(stack, None, Unpaced(), recording=False)
    try:
        firmware.load(EpisodeSetup(quad(), None, 1), None, 0)
        vehicle = Flown(firmware, RawClient(endpoint))
        vehicle.run(2)
        yield vehicle
    finally:
        firmware.close()


def test_what_is_set_is_kept_as_given_and_there_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "quad.params"
    with flown(path) as vehicle:
        vehicle.set("MPC_TILTMAX_AIR", 500.0)
        assert not path.exists()
        vehicle.run(80)  # a third of a second, as PX4 waits
        assert "MPC_TILTMAX_AIR\t500\t9" in path.read_text()
        vehicle.set("MPC_XY_CRUISE", 7.0)
    with flown(path) as vehicle:  # unsaved changes are saved at the end
        assert vehicle.get("MPC_TILTMAX_AIR") == 500.0
        assert vehicle.get("MPC_XY_CRUISE") == 7.0
        assert vehicle.get("MPC_THR_HOVER") == pytest.approx(0.52)  # the vehicle's own


def test_preflight_storage_resets_saves_and_loads(tmp_path: Path) -> None:
    path = tmp_path / "quad.params"
    with flown(path) as vehicle:
        vehicle.set("MPC_XY_CRUISE", 7.0)
        assert vehicle.command(PREFLIGHT_STORAGE, SAVE) == [ACCEPTED]
        saved = path.read_bytes()
        vehicle.set("MPC_XY_CRUISE", 9.0)
        assert vehicle.command(PREFLIGHT_STORAGE, LOAD) == [ACCEPTED]
        assert vehicle.get("MPC_XY_CRUISE") == 7.0
        assert vehicle.command(PREFLIGHT_STORAGE, RESET) == [ACCEPTED]
        assert vehicle.get("MPC_XY_CRUISE") == 5.0
        assert vehicle.get("MPC_THR_HOVER") == pytest.approx(0.52)
        assert path.read_bytes() == saved  # not yet
        vehicle.run(80)
        assert "MPC_XY_CRUISE" not in path.read_text()
        assert vehicle.command(PREFLIGHT_STORAGE, 3) == [ACCEPTED]
        assert vehicle.command(PREFLIGHT_STORAGE, 5) == []  # as PX4
        path.write_text("nonsense")
        assert vehicle.command(PREFLIGHT_STORAGE, LOAD) == [FAILED]
        path.unlink()
        path.mkdir()
        assert vehicle.command(PREFLIGHT_STORAGE, SAVE) == [FAILED]
        vehicle.set("MPC_XY_CRUISE", 8.0)
        vehicle.client.received()
        vehicle.run(80)
        texts = [m.text for m in vehicle.client.received("STATUSTEXT")]
        assert texts == ["Parameters could not be saved"]


def test_values_survive_the_file(tmp_path: Path) -> None:
    (third,) = struct.unpack("<f", struct.pack("<f", 1 / 3))
    values = {"MPC_XY_P": third, "SDLOG_MODE": -5, "CAL_ACC0_ID": 2**31 - 1, "BAT_LOW_THR": 1e-30}
    kept = KeptParameters(tmp_path / "a.params")
    assert kept.read() == {}
    kept.write(values)
    read = kept.read()
    assert {name: type(value) for name, value in read.items()} == {
        name: type(value) for name, value in values.items()
    }
    for name, value in values.items():
        assert struct.pack("<f", read[name]) == struct.pack("<f", value)


def test_names_that_are_lacking_here_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "a.params"
    path.write_text("# by QGroundControl\n\n1\t1\tNO_SUCH\t1\t6\n1\t1\tSDLOG_MODE\t2\t6\n")
    kept = KeptParameters(path)
    assert kept.read() == {"NO_SUCH": 1, "SDLOG_MODE": 2}
    assert Parameters({}, kept).changed() == {"SDLOG_MODE": 2}


@pytest.mark.parametrize("line", ["MPC_XY_P 1", "1\t1\tMPC_XY_P\tx\t9", "1\t1\tSDLOG_MODE\t1.5\t6"])
def test_what_is_no_file_of_parameters_is_refused_with_its_line(tmp_path: Path, line: str) -> None:
    path = tmp_path / "a.params"
    path.write_text(f"# a comment\n{line}\n")
    with pytest.raises(UsageError, match=r"a\.params: line 2: accepted: 5 columns"):
        KeptParameters(path).read()
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(UsageError, match="cannot be read"):
        KeptParameters(path).read()


def test_the_option_is_refused_where_it_has_no_meaning(tmp_path: Path) -> None:
    here = tmp_path / "a.params"
    check_vehicle(StandAloneVehicle(parameters_file=here))
    for asked in (
        StandAloneVehicle(parameters_file=here, lockstep=True),
        StandAloneVehicle(
            parameters_file=here, firmware="px4", real=RealFirmware(px4_dir=tmp_path)
        ),
        StandAloneVehicle(parameters_file=tmp_path / "none" / "a.params"),
    ):
        with pytest.raises(FieldError, match="parameters_file"):
            check_vehicle(asked)
