"""Messages on request, and rates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mavsdk.plugins.info import Info
from mavsdk.plugins.telemetry import Telemetry
from mavsdk.plugins.transponder import Transponder

from tests.support.px4_walk.row import OK, Row
from tests.support.px4_walk.vehicle import RefusedError, Vehicle

REQUEST_MESSAGE = 512

SENT = {
    242: "HOME_POSITION",
    49: "GPS_GLOBAL_ORIGIN",
    264: "FLIGHT_INFORMATION",
    395: "COMPONENT_INFORMATION",
    397: "COMPONENT_METADATA",
    435: "AVAILABLE_MODES",
    436: "CURRENT_MODE",
    300: "PROTOCOL_VERSION",
    245: "EXTENDED_SYS_STATE",
    2: "SYSTEM_TIME",
    261: "STORAGE_INFORMATION",
    147: "BATTERY_STATUS",
    30: "ATTITUDE",
    331: "ODOMETRY",
    141: "ALTITUDE",
    290: "ESC_INFO",
    291: "ESC_STATUS",
    241: "VIBRATION",
    375: "ACTUATOR_OUTPUT_STATUS",
    380: "TIME_ESTIMATE_TO_TARGET",
}

STREAMED = ("ATTITUDE", "ESC_STATUS", "TIME_ESTIMATE_TO_TARGET")
"""A real PX4 denies a request when nothing new has come since it streamed the last."""

NOT_SENT = {
    410: "EVENT",
    412: "REQUEST_EVENT",
    225: "EFI_STATUS",
    132: "DISTANCE_SENSOR",
}

RATES = (
    *("actuator_output_status", "altitude", "attitude_euler", "attitude_quaternion", "battery"),
    *("distance_sensor", "fixedwing_metrics", "gps_info", "health", "home", "imu", "in_air"),
    *("landed_state", "odometry", "position", "position_velocity_ned", "raw_gps", "rc_status"),
    *("scaled_imu", "velocity_ned", "vtol_state"),
)

CLOCK_HZ = {"odometry": 50.0, "position_velocity_ned": 50.0}
"""Streams of the walk's clock and position; their rates are not lowered [Hz]."""

NO_RATES = ("actuator_control_target", "raw_imu")


def _request(number: int, name: str) -> Callable[[Vehicle], Any]:
    def make(vehicle: Vehicle) -> Any:
        result, message = vehicle.command_and_message(REQUEST_MESSAGE, number, message=name)
        if result != "ACCEPTED":
            raise RefusedError(result)
        return message

    return make


def _rate(name: str) -> Callable[[Vehicle], Any]:
    return lambda vehicle: getattr(vehicle.plugin(Telemetry), f"set_rate_{name}")(
        CLOCK_HZ.get(name, 5.0)
    )


ROWS = (
    Row("info", "get_identification", lambda v: v.plugin(Info).get_identification()),
    Row("info", "get_product", lambda v: v.plugin(Info).get_product()),
    Row(
        "info",
        "get_version",
        lambda v: v.plugin(Info).get_version(),
        check=lambda found: (found.flight_sw_major, found.flight_sw_minor) == (1, 16),
    ),
    *(
        Row(
            "reqmsg",
            f"REQUEST_MESSAGE {name}",
            _request(number, name),
            (OK, "DENIED") if name in STREAMED else (OK,),
            lambda message: message is not None,
        )
        for number, name in SENT.items()
    ),
    *(
        Row("reqmsg", f"REQUEST_MESSAGE {name}", _request(number, name), ("DENIED",))
        for number, name in NOT_SENT.items()
    ),
    *(Row("rates", f"set_rate_{name}", _rate(name)) for name in RATES),
    *(Row("rates", f"set_rate_{name}", _rate(name), ("UNKNOWN",)) for name in NO_RATES),
    Row("misc", "transponder set_rate", lambda v: v.plugin(Transponder).set_rate_transponder(1.0)),
)
