"""REQUEST_DATA_STREAM: the deprecated request of streams by group.

A real PX4 ignores it. Here a request may only raise rates: MAVProxy asks for all streams at 4 Hz
when it connects, and another client on the same link must keep its 100 Hz attitude.
"""

from __future__ import annotations

from airl_mav.core.constants import US_PER_S
from firmware_sim.mavlink.codec import WireMessage, dialect
from firmware_sim.mavlink.scheduler import OFF
from firmware_sim.mavlink.services.context import Context

GROUPS: dict[int, tuple[str, ...]] = {
    dialect.MAV_DATA_STREAM_RAW_SENSORS: ("HIGHRES_IMU", "SCALED_PRESSURE", "GPS_RAW_INT"),
    dialect.MAV_DATA_STREAM_EXTENDED_STATUS: (
        "SYS_STATUS",
        "EXTENDED_SYS_STATE",
        "MISSION_CURRENT",
        "BATTERY_STATUS",
    ),
    dialect.MAV_DATA_STREAM_RC_CHANNELS: ("SERVO_OUTPUT_RAW",),
    dialect.MAV_DATA_STREAM_RAW_CONTROLLER: ("ATTITUDE_TARGET", "POSITION_TARGET_LOCAL_NED"),
    dialect.MAV_DATA_STREAM_POSITION: ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"),
    dialect.MAV_DATA_STREAM_EXTRA1: ("ATTITUDE",),
    dialect.MAV_DATA_STREAM_EXTRA2: ("VFR_HUD",),
    dialect.MAV_DATA_STREAM_EXTRA3: ("SYSTEM_TIME", "ESTIMATOR_STATUS", "VIBRATION"),
}


def handle_request(message: WireMessage, context: Context) -> bool:
    """Raise the rates of a group of streams, or restore its default rates."""
    if message.req_stream_id == dialect.MAV_DATA_STREAM_ALL:
        names = tuple(name for group in GROUPS.values() for name in group)
    else:
        names = GROUPS.get(message.req_stream_id, ())
    scheduler = context.link.scheduler
    start = message.start_stop == 1 and message.req_message_rate > 0
    for name in names:
        if not start:
            scheduler.set_interval(name, scheduler.default_us(name), context.now_us)
            continue
        asked_us = US_PER_S // message.req_message_rate
        present_us = scheduler.interval_us(name)
        if present_us == OFF or max(asked_us, 1) < present_us:
            scheduler.set_interval(name, max(asked_us, 1), context.now_us)
    return bool(names)
