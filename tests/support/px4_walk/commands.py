"""Single commands, and MAVSDK's calls that come down to one."""

from __future__ import annotations

from collections.abc import Callable
from queue import Queue
from typing import Any

from mavsdk.plugins.action import Action, RelayCommand
from mavsdk.plugins.calibration import Calibration, CalibrationResult
from mavsdk.plugins.camera import Camera
from mavsdk.plugins.events import Events
from mavsdk.plugins.gimbal import ControlMode, Gimbal
from mavsdk.plugins.gripper import Gripper

from tests.support.px4_walk.row import Row
from tests.support.px4_walk.vehicle import NO_ACK, RefusedError, Vehicle

RESULTS = {
    "GET_HOME_POSITION": (410, (), "ACCEPTED"),
    "REQUEST_AUTOPILOT_CAPABILITIES": (520, (1,), "ACCEPTED"),
    "REQUEST_PROTOCOL_VERSION": (519, (1,), "ACCEPTED"),
    "GET_MESSAGE_INTERVAL 32": (510, (32,), "ACCEPTED"),
    "SET_MESSAGE_INTERVAL of an unknown message": (511, (9999, 1e5), "FAILED"),
    "RUN_PREARM_CHECKS": (401, (), "ACCEPTED"),
    "DO_SET_ACTUATOR": (187, (0.1,), "ACCEPTED"),
    "DO_GO_AROUND": (191, (), "ACCEPTED"),
    "DO_SET_STANDARD_MODE land": (262, (7,), "ACCEPTED"),
    "DO_SET_STANDARD_MODE cruise": (262, (3,), "FAILED"),
    "DO_FENCE_ENABLE": (207, (1,), "UNSUPPORTED"),
    "DO_MOTOR_TEST": (209, (1, 0, 10, 1), "UNSUPPORTED"),
    "NAV_LOITER_UNLIM": (17, (), "UNSUPPORTED"),
    "DO_SET_SERVO": (183, (1, 1500), "UNSUPPORTED"),
    "CONTROL_HIGH_LATENCY": (2600, (1,), "FAILED"),
    "PREFLIGHT_STORAGE save": (245, (1,), "ACCEPTED"),
    "an unknown command": (31_000, (), "UNSUPPORTED"),
}

UNACKNOWLEDGED = {
    "ACTUATOR_TEST": (310, (0.1, 1, 0, 0, 101)),
    "COMPONENT_ARM_DISARM 2": (400, (2,)),
    "SET_CAMERA_MODE": (530, ()),
    "DO_DIGICAM_CONTROL": (203, ()),
}


def _command(number: int, params: tuple[float, ...]) -> Callable[[Vehicle], str]:
    def make(vehicle: Vehicle) -> str:
        result = vehicle.command(number, *params)
        if result != "ACCEPTED":
            raise RefusedError(result)
        return result

    return make


def _gyro(vehicle: Vehicle) -> CalibrationResult:
    results: Queue[CalibrationResult] = Queue()
    vehicle.plugin(Calibration).calibrate_gyro_async(lambda result, *_: results.put(result))
    while (result := results.get(timeout=30.0)) is CalibrationResult.NEXT:
        pass
    if result is not CalibrationResult.SUCCESS:
        raise RefusedError(result.name)
    return result


def _row(name: str, number: int, params: tuple[float, ...], result: str) -> Row:
    expected = ("ok",) if result == "ACCEPTED" else (result,)
    return Row("command", name, _command(number, params), expected, slow=result == NO_ACK)


def _take_control(vehicle: Vehicle) -> Any:
    return vehicle.plugin(Gimbal).take_control(0, ControlMode.PRIMARY)


ROWS = (
    Row("action", "set_actuator 1", lambda v: v.plugin(Action).set_actuator(1, 0.1)),
    Row(
        "action",
        "set_relay 0 on",
        lambda v: v.plugin(Action).set_relay(0, RelayCommand.ON),
        ("UNSUPPORTED",),
    ),
    Row(
        "action",
        "transition_to_fixedwing",
        lambda v: v.plugin(Action).transition_to_fixedwing(),
        ("NO_VTOL_TRANSITION_SUPPORT",),
    ),
    *(_row(name, *facts) for name, facts in RESULTS.items()),
    *(_row(name, *facts, NO_ACK) for name, facts in UNACKNOWLEDGED.items()),
    Row(
        "misc",
        "camera take_photo of the autopilot",
        lambda v: v.plugin(Camera).take_photo(1),
        ("ACTION_UNSUPPORTED",),
    ),
    Row(
        "misc",
        "camera take_photo of component 100",
        lambda v: v.plugin(Camera).take_photo(100),
        ("TIMEOUT",),
        slow=True,
    ),
    Row("misc", "gimbal take_control", _take_control, ("TIMEOUT",), slow=True),
    Row("misc", "gripper grab", lambda v: v.plugin(Gripper).grab(0), ("TIMEOUT",), slow=True),
    Row(
        "misc",
        "health and arming checks report",
        lambda v: v.plugin(Events).get_health_and_arming_checks_report(),
        ("NOT_AVAILABLE",),
    ),
    Row("misc", "calibrate_gyro", _gyro),
)
