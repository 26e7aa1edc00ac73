"""Parameters."""

from __future__ import annotations

from typing import Any

from mavsdk.plugins.action import Action
from mavsdk.plugins.param import Param

from tests.support.px4_walk.row import OK, Row
from tests.support.px4_walk.vehicle import Vehicle

AREA = "param"

FLOATS = {
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_XY_CRUISE": 5.0,
    "RTL_RETURN_ALT": 30.0,
    "COM_OF_LOSS_T": 1.0,
    "COM_OBC_LOSS_T": 5.0,
    "GF_MAX_HOR_DIST": 0.0,
    "BAT_LOW_THR": 0.15,
    "MC_ROLLRATE_P": 0.15,
    "EKF2_GPS_DELAY": 10.0,
    "MPC_ACC_HOR": 3.0,
}

INTEGERS = {
    "SYS_AUTOSTART": 10016,
    "COM_OBL_RC_ACT": 0,
    "COM_RC_IN_MODE": 1,
    "NAV_RCL_ACT": 2,
    "NAV_DLL_ACT": 0,
    "COM_LOW_BAT_ACT": 3,
    "CA_ROTOR_COUNT": 4,
    "SDLOG_MODE": 1,
    "CBRK_SUPPLY_CHK": 0,
}

ABSENT = ("TIMEOUT", "DOES_NOT_EXIST", "NAME_NOT_FOUND", "PARAM_NOT_FOUND")
"""PX4 1.16 says nothing; a newer autopilot answers PARAM_ERROR at once."""


def _all(vehicle: Vehicle) -> tuple[int, int]:
    found = vehicle.plugin(Param).get_all_params()
    return len(found.int_params), len(found.float_params)


def _set_and_read(name: str, value: float) -> Any:
    """A float is set as a float parameter, an int as an integer one; it is put back."""
    kind = "int" if isinstance(value, int) else "float"

    def make(vehicle: Vehicle) -> float:
        param = vehicle.plugin(Param)
        read, write = (getattr(param, f"{verb}_param_{kind}") for verb in ("get", "set"))
        before = read(name)
        try:
            write(name, value)
            return float(read(name))
        finally:
            write(name, before)

    return make


def _close(value: float) -> Any:
    return lambda found: abs(found - value) < 1e-6


def _read(name: str, value: float) -> Row:
    kind = "int" if isinstance(value, int) else "float"
    return Row(
        AREA,
        f"get_param_{kind} {name}",
        lambda v: getattr(v.plugin(Param), f"get_param_{kind}")(name),
        check=_close(value),
    )


def _altitude(of: str, value: float) -> Any:
    def make(vehicle: Vehicle) -> float:
        action = vehicle.plugin(Action)
        read, write = (getattr(action, f"{verb}_{of}_altitude") for verb in ("get", "set"))
        before = read()
        write(value)
        found = float(read())
        write(before)
        return found

    return make


ROWS = (
    # A SITL has these, give or take those that a driver brings along.
    Row(AREA, "get_all_params", _all, check=lambda n: n[0] >= 274 and n[1] >= 603),
    *(_read(name, value) for name, value in (FLOATS | INTEGERS).items()),
    Row(
        AREA,
        "get_param_int of a float",
        lambda v: v.plugin(Param).get_param_int("MPC_XY_P"),
        ("WRONG_TYPE",),
    ),
    Row(
        AREA,
        "get_param_float of an unknown name",
        lambda v: v.plugin(Param).get_param_float("NO_SUCH"),
        ABSENT,
        slow=True,
    ),
    Row(
        AREA,
        "set_param_float of an unknown name",
        lambda v: v.plugin(Param).set_param_float("NO_SUCH", 1.0),
        ABSENT,
        slow=True,
    ),
    Row(AREA, "set_param_float, read back", _set_and_read("MIS_TAKEOFF_ALT", 6.0), check=_close(6)),
    Row(
        AREA,
        "set_param_float out of range, read back",
        _set_and_read("MPC_TILTMAX_AIR", 500.0),
        (OK,),
        _close(500.0),
    ),
    Row(
        AREA,
        "set_param_int, read back",
        _set_and_read("COM_RC_IN_MODE", 2),
        check=lambda found: found == 2,
    ),
    Row(
        AREA,
        "get_param_custom",
        lambda v: v.plugin(Param).get_param_custom("MPC_XY_P"),
        ("TIMEOUT", "WRONG_TYPE"),
        slow=True,
    ),
    Row("action", "takeoff altitude", _altitude("takeoff", 8.0), check=_close(8.0)),
    Row("action", "return altitude", _altitude("return_to_launch", 15.0), check=_close(15.0)),
)
