"""The quick way to a frame, against pymavlink's own `pack()`: every message, awkward values."""

from __future__ import annotations

import inspect
import itertools
import math
import struct
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from airl_mav.core.frames import local_to_geodetic, quat_from_euler, quat_to_euler, quat_yaw
from firmware_sim.addons.ground_station_services.information import SILENT
from firmware_sim.autopilot.autopilot_state import Arming, Setpoint
from firmware_sim.autopilot.flight_modes import Mode
from firmware_sim.autopilot.snapshot import AutopilotState
from firmware_sim.interfaces import BatterySample
from firmware_sim.mavlink.codec import SYSTEM_ID, Encoder, Values, WireLayout, dialect, layout
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.link import Link, Payloads
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.streams import BUILDERS, addon_builders, units
from firmware_sim.mavlink.telemetry import payload
from tests.support.kinematic_autopilot import ORIGIN, KinematicAutopilot
from tests.support.mavlink_clients import Bench

KINDS: dict[str, Any] = {kind.msgname: kind for kind in dialect.mavlink_map.values()}
INTEGERS = {
    "int8_t": (-(2**7), 2**7 - 1),
    "uint8_t": (0, 2**8 - 1),
    "int16_t": (-(2**15), 2**15 - 1),
    "uint16_t": (0, 2**16 - 1),
    "int32_t": (-(2**31), 2**31 - 1),
    "uint32_t": (0, 2**32 - 1),
    "int64_t": (-(2**63), 2**63 - 1),
    "uint64_t": (0, 2**64 - 1),
}
FLOATS = (0.0, -0.0, 1.0, -2.5, math.nan, math.inf, -math.inf, 3.4e38, 1e-45, 0.1)


def sizes(kind: Any) -> dict[str, int]:
    """Return how many values each field takes; a text is one."""
    return dict(zip(kind.ordered_fieldnames, kind.lengths, strict=True))


def as_fields(kind: Any, values: Values) -> list[Any]:
    """Return the arguments of pymavlink's class: arrays as lists."""
    rest = iter(values)
    arrays = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    fields: list[Any] = []
    for name in kind.fieldnames:
        taken = list(itertools.islice(rest, sizes(kind)[name]))
        if not taken:
            break  # extension fields left out: pymavlink's defaults
        is_array = arrays[name] and not isinstance(taken[0], bytes)
        fields.append(taken if is_array else taken[0])
    assert not list(rest)
    return fields


def pymavlinks(kind: Any, values: Values, seq: int = 0) -> bytes:
    """Return what pymavlink makes of the same values."""
    mav = dialect.MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=1)
    mav.seq = seq
    frame: bytes = kind(*as_fields(kind, values)).pack(mav)
    return frame


def ours(kind: Any, values: Values) -> bytes:
    shape = WireLayout(kind)
    return Encoder().frame(shape, shape.payload(values))


def packed(pack: Callable[[], bytes]) -> bytes | type[Exception]:
    """Return the frame, or the exception type if a value does not fit."""
    try:
        return pack()
    except (struct.error, OverflowError) as error:
        return type(error)


def samples(kind: Any) -> Iterator[list[Any]]:
    """Yield awkward values for all fields of a message, unrolled."""
    rng = np.random.default_rng(kind.id)
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    slots = [types[name] for name in kind.fieldnames for _ in range(sizes(kind)[name])]
    texts = (b"", b"A", b"\0B", b"Z" * 300)

    def low(of: str) -> Any:
        if of in INTEGERS:
            return INTEGERS[of][0]
        return b"" if of == "char" else -math.inf

    def high(of: str) -> Any:
        if of in INTEGERS:
            return INTEGERS[of][1]
        return b"Z" * 300 if of == "char" else math.nan

    def some(of: str) -> Any:
        if of in INTEGERS:
            return int(rng.integers(*INTEGERS[of], dtype=of.removesuffix("_t"), endpoint=True))
        return texts[rng.integers(4)] if of == "char" else FLOATS[rng.integers(len(FLOATS))]

    def zero(of: str) -> Any:
        return b"" if of == "char" else 0

    yield [low(of) for of in slots]
    yield [high(of) for of in slots]
    yield [zero(of) for of in slots]
    for _ in range(10):
        values = [some(of) for of in slots]
        yield values
        # Zeros from a random place on: MAVLink 2 cuts them.
        keep = int(rng.integers(len(slots)))
        yield values[:keep] + [zero(of) for of in slots[keep:]]


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_every_message_of_the_dialect(kind: Any) -> None:
    parameters = inspect.signature(kind).parameters.values()
    extensions = [p.name for p in parameters if p.default is not inspect.Parameter.empty]
    for values in samples(kind):
        assert ours(kind, values) == pymavlinks(kind, values)
        # And without each possible number of extension fields.
        for cut in itertools.accumulate(sizes(kind)[name] for name in reversed(extensions)):
            short = values[: len(values) - cut]
            assert ours(kind, short) == pymavlinks(kind, short)


def test_frames_and_packed_messages_share_one_sequence() -> None:
    encoder, shape = Encoder(), layout("ATTITUDE")
    values = (1, *[0.5] * 6)
    for seq in range(0, 600, 2):
        frame = encoder.frame(shape, shape.payload(values))
        assert frame == pymavlinks(KINDS["ATTITUDE"], values, seq % 256)
        message = dialect.MAVLink_ping_message(1, 2, 3, 4)
        assert encoder.pack(message) == pymavlinks(KINDS["PING"], (1, 2, 3, 4), (seq + 1) % 256)


@pytest.mark.parametrize("count", [0, 5, 6, 8, 30])
def test_a_wrong_number_of_values_is_an_error(count: int) -> None:
    with pytest.raises(struct.error, match=rf"{count} values, expected \[7\]"):
        layout("ATTITUDE").payload([0] * count)


def test_messages_are_known_by_name() -> None:
    assert layout("ATTITUDE") is layout("ATTITUDE")
    with pytest.raises(AttributeError):
        layout("NO_SUCH_MESSAGE")


# --- what the streams say


def streams(bench: Bench) -> dict[str, Callable[[AutopilotState], Values | None] | None]:
    """Return every builder of the onboard link; None = compiled code packs it."""
    (clients, _) = bench.server._links
    (client,) = clients
    return dict(client.link.builders)


PYMAVLINK = dialect.MAVLink(None, srcSystem=1, srcComponent=1)


def decoded(name: str, state: AutopilotState) -> Any:
    """Return the message of a fast stream as pymavlink reads it; None = there is nothing to say."""
    told = payload(name, state)
    if told is None:
        return None
    return PYMAVLINK.decode(bytearray(Encoder().frame(layout(name), told)))


def check_streams(autopilot: KinematicAutopilot, bench: Bench) -> set[str]:
    """Compare each stream's frame with pymavlink's; return the streams that sent a frame."""
    state, spoken = autopilot.state(), set()
    for name, build in streams(bench).items():
        if build is None:
            if (told := decoded(name, state)) is not None:
                spoken.add(name)
                assert told.pack(PYMAVLINK) == bytes(told.get_msgbuf())
            continue
        values = build(state)
        if values is None:
            continue
        spoken.add(name)
        kind = KINDS[name]
        assert packed(partial(ours, kind, values)) == packed(partial(pymavlinks, kind, values))
    return spoken


def test_every_stream_at_rest() -> None:
    bench = Bench()
    bench.run(0.2)
    own = {"SYSTEM_TIME", "VIBRATION", "BATTERY_STATUS", "TIMESYNC", "PING"}
    own |= {"AUTOPILOT_VERSION", "TIME_ESTIMATE_TO_TARGET", "MAG_CAL_REPORT"}
    # There is no plant, no manual control input, and no radio.
    lacking = {"HIL_STATE_QUATERNION", "MANUAL_CONTROL", "RC_CHANNELS"}
    own |= lacking | addon_builders().keys()
    assert set(streams(bench)) == BUILDERS.keys() | own
    # There is no orbit, no target position, and no sensor that looks down.
    idle = {"ORBIT_EXECUTION_STATUS", "POSITION_TARGET_GLOBAL_INT"}
    idle |= {"DISTANCE_SENSOR", "OPTICAL_FLOW_RAD"}
    silent = idle | lacking | set(SILENT)
    assert check_streams(bench.autopilot, bench) == (BUILDERS.keys() | own) - silent


@given(numbers=st.lists(st.floats(), min_size=24, max_size=24), armed=st.booleans())
def test_every_stream_with_any_numbers(numbers: list[float], armed: bool) -> None:
    autopilot = KinematicAutopilot()
    bench = Bench(autopilot=autopilot)
    autopilot.velocity, autopilot.accel, autopilot.gyro, autopilot.mag = np.reshape(
        numbers[:12], (4, 3)
    )
    autopilot.battery = BatterySample(*numbers[12:16])
    autopilot.arming = Arming.ARMED if armed else Arming.STANDBY
    autopilot.mode = Mode.OFFBOARD
    position, velocity = np.reshape(numbers[16:22], (2, 3))
    autopilot.offer_setpoint(Setpoint(position, velocity, numbers[22], numbers[23]), 0)
    assert {"HEARTBEAT", "ATTITUDE", "ODOMETRY", "HIGHRES_IMU"} <= check_streams(autopilot, bench)
    autopilot.origin, autopilot.home = ORIGIN, ORIGIN._replace(altitude_m=2.5)
    assert {"GPS_RAW_INT", "GLOBAL_POSITION_INT", "HOME_POSITION"} <= check_streams(
        autopilot, bench
    )


@given(
    position=st.lists(st.floats(-1e7, 1e7), min_size=3, max_size=3),
    velocity=st.lists(st.floats(), min_size=3, max_size=3),
    angles=st.lists(st.floats(-7.0, 7.0), min_size=3, max_size=3),
    home_m=st.none() | st.floats(-1e7, 1e7),
)
def test_the_compiled_conversions_are_those_of_python(
    position: list[float], velocity: list[float], angles: list[float], home_m: float | None
) -> None:
    autopilot = KinematicAutopilot()
    autopilot.origin = ORIGIN
    autopilot.home = None if home_m is None else ORIGIN._replace(altitude_m=home_m)
    autopilot.position, autopilot.velocity = np.array(position), np.array(velocity)
    autopilot.roll, autopilot.pitch, autopilot.yaw = angles
    state = autopilot.state()
    here = local_to_geodetic(autopilot.position, ORIGIN)
    quaternion = quat_from_euler(*angles)
    told = decoded("GLOBAL_POSITION_INT", state)
    got = [getattr(told, field) for field in told.get_fieldnames()]
    above = -position[2] if home_m is None else here.altitude_m - home_m
    expected = (
        units.boot_ms(autopilot.time_us),
        units.deg_e7(here.latitude_deg),
        units.deg_e7(here.longitude_deg),
        units.mm(here.altitude_m),
        units.mm(above),
        *map(units.cm_s, velocity),
        units.centidegrees(quat_yaw(quaternion)),
    )
    # Two mathematical libraries: where the last bit decides, they may round to either side.
    off = np.abs(np.subtract(got, expected))
    off[-1] = min(off[-1], 36_000 - off[-1])
    assert off.max() <= 1
    told = decoded("ATTITUDE", state)
    assert (told.roll, told.pitch, told.yaw) == pytest.approx(quat_to_euler(quaternion), abs=1e-6)


def test_what_two_links_send_is_built_once() -> None:
    calls: list[str] = []

    def build(name: str) -> Callable[[AutopilotState], Values]:
        def builder(state: AutopilotState) -> Values:
            calls.append(name)
            return (state.time_us, len(calls), 0, 0)

        return builder

    shared = build("shared")
    ends = [MemoryEndpoint(), MemoryEndpoint()]
    links = [Link(onboard_link(end), {"PING": shared}) for end in ends]
    alone = Link(onboard_link(MemoryEndpoint()), {"PING": build("own")})
    state = KinematicAutopilot().state()
    payloads: Payloads = {}
    links[1].send(dialect.MAVLink_ping_message(0, 0, 0, 0))  # another sequence number there
    for link in (*links, alone):
        link.stream_due(["PING"], state, payloads)
        link.flush()
    assert calls == ["shared", "own"]
    first, second = ends[0].take()[0], ends[1].take()[1]
    expected = (state.time_us, 1, 0, 0)
    assert first == pymavlinks(KINDS["PING"], expected)
    assert second == pymavlinks(KINDS["PING"], expected, seq=1)


def test_a_value_that_does_not_fit_costs_its_message_only() -> None:
    end = MemoryEndpoint()
    builders: dict[str, Any] = {
        "PING": lambda _: (-1, 0, 0, 0),
        "SCALED_PRESSURE": lambda _: (0, 1e300, 0, 0),
        "HEARTBEAT": BUILDERS["HEARTBEAT"],
    }
    link = Link(onboard_link(end), builders)
    state = KinematicAutopilot().state()
    link.stream_due(builders, state, {})
    link.flush()
    assert link.send_stream("PING", state)
    assert (link.counters.tx, link.counters.send_errors) == (1, 3)
    (frame,) = end.take()
    assert frame[4] == 0
    assert frame[7:10] == layout("HEARTBEAT").id_bytes
