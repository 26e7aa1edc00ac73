"""Fuzz test of inputs other than MAVLink: user files, camera frames, PX4's simulator port.

    python scripts/fuzz_inputs.py --seconds 600

User files (vehicles, arenas, computers, scenarios, trainings, sweeps, parameters, keys) are damaged
at random, in bytes and values, and read as the commands read them. Each must be accepted, with a
short flight if possible, or rejected with one line. Depth frames with wrong lengths, sizes, numbers
and stamps are published to the camera of a companion, whose policy decides on valid frames. A PX4
that sends garbage, half a frame, or ends its connection after any byte, must end the flight with a
defined error. The test stops at the first other result, and prints the case, which `--what WHAT
--first NUMBER` repeats.
"""

from __future__ import annotations

import math
import os
import socket
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
import zmq

from airl_mav.addons.sweep.config import SweepConfig
from airl_mav.camera.frame import Frame, FurtherImage
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.cli.options import read_options, scenario_of
from airl_mav.cli.sitl_command import SitlOptions
from airl_mav.core.clock import SimClock, WallClock
from airl_mav.core.constants import LOOPBACK, TICK_US, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.core.signing import read_key
from airl_mav.policy.greedy import GreedyPolicy
from airl_mav.policy.observation import Kinematics, encode
from airl_mav.profiles.loading import load_profile, profiles_dir
from airl_mav.rehearsal.firmware_process import aircraft_of, episode_of
from airl_mav.scenario.resolve import resolve
from airl_mav.scenario.stand_alone import StandAloneVehicle, check_vehicle
from airl_mav.training.config import TrainingConfig
from companion.frame_source import ZmqFrameSource
from companion.pilot import OLDEST_FRAME_US, age_of
from firmware_sim.autopilot.autopilot import BuiltinAutopilot
from firmware_sim.autopilot.parameter_store import Parameters
from firmware_sim.external.launcher import no_process
from firmware_sim.external.parameters import KeptParameters, qgroundcontrol_file
from firmware_sim.external.px4_sitl import EPOCH_US, Px4Bridge
from firmware_sim.interfaces import (
    BatterySample,
    FirmwareLostError,
    FirmwareMissingError,
    SensorSample,
)
from firmware_sim.mavlink.codec import Encoder, dialect
from firmware_sim.simulation import Simulation

What = Literal["files", "camera", "simulator"]

VALUES = (
    "0", "-0", "1", "-1", "2", "1e308", "-1e308", "1e-308", "5e-324", "nan", "inf", "-inf",
    "true", "false", '""', '"x"', '"nan"', '"\\u0000"', '"../../etc/passwd"', '"/dev/null"',
    '"x.toml"', "[]", "[1]", "[1, 2]", "[2, 1]", "[-1, 0]", "[1.5, 2.5]", "[nan, nan]", '["a"]',
    "{}", "{a = 1}", "99999999999999999999", "9" * 30, "-9223372036854775808", "2147483648",
    "1979-05-27", "07:32:00", "[" * 40 + "]" * 40, "",
)  # fmt: skip
"""Replacement values."""

LINES = ("[", "]", "=", "a", "a = ", "[a]", "[[a]]", "[size]", 'base = "quad"', "\t", "\r", '"""')

SCENARIO = """episodes = 2
seed = 3
policy = "greedy"
speed = 1.0
[wind]
east_m_s = 2.0
[[faults]]
part = "gps"
kind = "off"
at_s = 2.0
"""


def damaged(rng: np.random.Generator, text: bytes) -> bytes:
    """Return a text with one to three random defects in its values, lines or bytes."""
    for _ in range(1 + int(rng.integers(3))):
        lines = text.split(b"\n")
        at = int(rng.integers(len(lines)))
        kind = int(rng.integers(8))
        if kind <= 3 and b"=" in lines[at]:
            name = lines[at].partition(b"=")[0]
            lines[at] = name + b"= " + VALUES[int(rng.integers(len(VALUES)))].encode()
        elif kind == 4:
            del lines[at]
        elif kind == 5:
            lines.insert(at, lines[int(rng.integers(len(lines)))])
        elif kind == 6:
            lines.insert(at, LINES[int(rng.integers(len(LINES)))].encode())
        else:
            raw = bytearray(b"\n".join(lines)) or bytearray(b" ")
            where = int(rng.integers(len(raw)))
            if rng.random() < 0.2:
                del raw[where:]
            else:
                raw[where] = int(rng.integers(256))
            lines = bytes(raw).split(b"\n")
        text = b"\n".join(lines)
    return text


# --- files ---------------------------------------------------------------------------------------


def _fly(asked: StandAloneVehicle) -> None:
    """Build the setup of `airl-firmware`, and fly three ticks."""
    check_vehicle(asked)
    vehicle, computer_w = aircraft_of(asked)
    setup, _goal = episode_of(asked, vehicle, computer_w)
    clock = SimClock()
    simulation = Simulation(setup, start_us=0, clock=clock, recording=False)
    with closing(simulation):
        for _ in range(3):
            simulation.tick()
        assert np.isfinite(simulation.plant.motion).all(), "the vehicle is nowhere"


def _parameters(path: Path) -> None:
    autopilot = BuiltinAutopilot(Parameters({}, KeptParameters(path)))
    rest = np.array([0.0, 0.0, -9.81])
    for tick in range(3):
        autopilot.step(_sample(tick * TICK_US, rest))


READERS: Mapping[str, Callable[[Path], object]] = {
    "vehicles": lambda path: _fly(StandAloneVehicle(vehicle=str(path), arena="no-obstacles")),
    "arenas": lambda path: _fly(StandAloneVehicle(arena=str(path))),
    "computers": lambda path: _fly(StandAloneVehicle(computer=str(path), arena="no-obstacles")),
    "training": lambda path: load_profile("training", str(path), TrainingConfig),
    "sweeps": lambda path: load_profile("sweeps", str(path), SweepConfig),
    "scenario": lambda path: resolve(scenario_of(read_options(SitlOptions, "airl", [str(path)]))),
    "parameters": _parameters,
    "key": read_key,
}
"""Reader of each kind of file; flies if possible without starting a process."""


def _shipped(kind: str) -> list[bytes]:
    if kind == "scenario":
        return [SCENARIO.encode()]
    if kind == "parameters":
        kept = {"MPC_XY_VEL_MAX": 8.0, "COM_RC_IN_MODE": 1, "RTL_TYPE": 2, "EKF2_GPS_DELAY": 10.0}
        return [qgroundcontrol_file(kept).encode()]
    if kind == "key":
        return [b"ab" * 32 + b"\n"]
    return [path.read_bytes() for path in sorted((profiles_dir() / kind).glob("*.toml"))]


def read_damaged_file(number: int, kind: str | None = None) -> str:
    """Read a damaged file of a kind (None: any); return the result.

    Raises:
        Exception: The file was neither accepted nor rejected with one line.
    """
    rng = np.random.default_rng((number, 1))
    kind = kind or list(READERS)[number % len(READERS)]
    texts = _shipped(kind)
    text = damaged(rng, texts[int(rng.integers(len(texts)))])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "mine.toml")
        path.write_bytes(text)
        path.chmod(0o600)
        try:
            READERS[kind](path)
        except UsageError as error:
            assert str(error).strip(), "refused without a word"
            assert "\n" not in str(error), f"more than one line: {error}"
            return f"{kind} refused"
        except SystemExit as end:  # tyro rejects command-line words.
            assert end.code == 2, f"exit status {end.code}"
            return f"{kind} refused"
        except BaseException:
            kept = Path(tempfile.gettempdir(), f"fuzz-{kind}-{number}.toml")
            kept.write_bytes(text)
            print(f"the file: {kept}")
            raise
    return f"{kind} taken"


# --- camera --------------------------------------------------------------------------------------

LENSES = (
    Intrinsics.from_fov(16, 12, math.pi / 2),
    Intrinsics.from_fov(16, 12, 2.0 * math.pi, "cylindrical"),
    Intrinsics.from_fov(16, 12, math.pi / 2, kind="rgb"),
    Intrinsics.from_fov(16, 12, 2.0 * math.pi, "cylindrical", "grey"),
    Intrinsics.from_fov(16, 12, math.pi, "fisheye"),
    Intrinsics.from_fov(16, 12, 2.0, "fisheye", "rgb", (-0.05, 0.008, -0.0045, 0.0004)),
)
STAMPS = (0, 1, -1, 2**63 - 1, -(2**63), US_PER_S, 10**15)
NUMBERS = (0.0, -1.0, 1e-320, 1e308, math.nan, math.inf, -math.inf, 8.0)
SIDES = (0, 1, 2, 12, 16, 17, 255, 65_535)


def hostile_frame(rng: np.random.Generator, lens: Intrinsics = LENSES[0]) -> bytes:
    """Return the bytes of a frame, valid or with one defect."""
    image = rng.integers(0, np.iinfo(lens.dtype).max + 1, lens.shape, lens.dtype)
    frame = bytearray(Frame(int(rng.integers(1 << 62)), 0, image, lens).to_bytes())
    kind = int(rng.integers(8))
    if kind == 1:
        struct.pack_into("<q", frame, 12, STAMPS[int(rng.integers(len(STAMPS)))])
    elif kind == 2:
        which = 24 + 8 * int(rng.integers(3))
        struct.pack_into("<d", frame, which, NUMBERS[int(rng.integers(len(NUMBERS)))])
    elif kind == 3:
        width, height = (SIDES[int(i)] for i in rng.integers(len(SIDES), size=2))
        struct.pack_into("<HH", frame, 20, width, height)
        if width * height < 10_000:
            frame[48:] = bytes(2 * width * height)
    elif kind == 4:
        del frame[int(rng.integers(len(frame))) :]
    elif kind == 5:
        frame += rng.bytes(1 + int(rng.integers(100)))
    elif kind == 6:
        frame[int(rng.integers(len(frame)))] = int(rng.integers(256))
    elif kind == 7:
        frame = bytearray(rng.bytes(int(rng.integers(600))))
    return bytes(frame)


def hostile_rig(rng: np.random.Generator, lens: Intrinsics) -> bytes:
    """Return the bytes of a frame of two cameras, valid or with one defect."""
    image = np.zeros(lens.shape, lens.dtype)
    sequence = int(rng.integers(1 << 62))
    further = {"side": FurtherImage(image, lens)}
    frame = bytearray(Frame(sequence, 0, image, lens, further=further).to_bytes())
    kind = int(rng.integers(6))
    if kind == 1:
        parts = [(name, hostile_frame(rng, lens)) for name in (b"", b"side")]
        frame = bytearray(struct.pack("<4sH", b"AMF1", 2))
        for name, message in parts:
            frame += struct.pack("<BI", len(name), len(message)) + name + message
    elif kind == 2:
        struct.pack_into("<H", frame, 4, SIDES[int(rng.integers(len(SIDES)))])
    elif kind == 3:
        struct.pack_into("<I", frame, 7, int(rng.integers(1 << 32)))
    elif kind == 4:
        del frame[int(rng.integers(len(frame))) :]
    elif kind == 5:
        frame[int(rng.integers(len(frame)))] = int(rng.integers(256))
    return bytes(frame)


def see_hostile_frames(number: int, frames: int = 50) -> str:
    """Publish frames to a companion's camera and decide on each valid one; return the tally.

    Raises:
        Exception: A frame caused an error, or an action is NaN or infinite.
    """
    rng = np.random.default_rng((number, 2))
    lens = LENSES[number % len(LENSES)]
    policy, clock = GreedyPolicy(), SimClock()
    still = Kinematics(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    passed, hostile = 0, hostile_rig if number % 4 == 3 else hostile_frame
    with zmq.Context() as context, context.socket(zmq.PUB) as publisher:
        publisher.bind("inproc://camera")
        source = ZmqFrameSource("inproc://camera", clock, context)
        with closing(source):
            for _ in range(frames):
                clock.advance(33_333)
                if rng.random() < 0.1:
                    publisher.send_multipart([hostile(rng, lens), hostile(rng, lens)])
                else:
                    publisher.send(hostile(rng, lens))
                seen = source.wait(-1, 0.0)
                if seen is None:
                    continue
                passed += 1
                now_us = clock.time_us()
                assert 0 <= age_of(seen, now_us) <= max(OLDEST_FRAME_US, now_us)
                k = seen.frame.intrinsics
                assert seen.frame.image.shape == k.shape
                if k.kind != "depth":
                    continue  # A companion rejects such a camera for its policy before take-off.
                action = policy.act(encode(seen.frame, still, (20.0, 5.0))).within(5.0)
                numbers = (action.forward_m_s, action.right_m_s, action.yaw_rate_rad_s)
                assert all(map(math.isfinite, numbers)), action
            return f"{source.malformed} of {frames} frames refused"


# --- PX4's simulator port ------------------------------------------------------------------------

ANSWER_S = 0.05
"""Answer timeout: garbage gets no answer [wall s]."""


def _sample(time_us: int, accel: np.ndarray) -> SensorSample:
    return SensorSample(time_us, accel, np.zeros(3), 25.0, BatterySample(16.0, 1.0, 0.0, 1.0))


def answers(samples: int) -> list[bytes]:
    """Return the messages of a PX4 that answers a number of samples: a piece for each."""
    encoder = Encoder(1, 1)
    ask = dialect.MAVLink_command_long_message(0, 0, 511, 0, 115.0, 5e3, 0.0, 0.0, 0.0, 0.0, 0.0)
    pieces = [encoder.pack(ask)]
    for sample in range(samples):
        motors = [0.5] * 4 + [0.0] * 12
        time_us = EPOCH_US + sample * TICK_US
        message = dialect.MAVLink_hil_actuator_controls_message(time_us, motors, 129, 1)
        pieces.append(encoder.pack(message))
    return [b"".join(pieces[:2]), *pieces[2:]]


def hostile_px4(rng: np.random.Generator, samples: int) -> list[bytes]:
    """Return the messages of a faulty PX4 before it disconnects: a piece for each sample."""
    pieces = [bytearray(piece) for piece in answers(samples)]
    which = int(rng.integers(len(pieces)))
    piece, kind = pieces[which], int(rng.integers(4))
    at = int(rng.integers(len(piece)))
    if kind == 0:
        del piece[at:], pieces[which + 1 :]
    elif kind == 1:
        piece[:] = rng.bytes(1 + int(rng.integers(6_000)))
    elif kind == 2:
        for _ in range(1 + int(rng.integers(20))):
            piece[int(rng.integers(len(piece)))] = int(rng.integers(256))
    else:
        piece[at:at] = rng.bytes(1 + int(rng.integers(300)))
    return [bytes(piece) for piece in pieces]


def be_connected_to(pieces: list[bytes]) -> str:
    """Send a piece with each sample from a PX4, then disconnect; return the bridge's result.

    Raises:
        Exception: Any error except lost or missing firmware.
    """
    rest = np.array([0.0, 0.0, -9.81])
    with closing(Px4Bridge(0, answer_s=ANSWER_S, start_s=ANSWER_S)) as bridge:
        peer = socket.create_connection((LOOPBACK, bridge.port))
        answered = 0
        try:
            bridge.wait_connected(1.0, no_process)
            for tick, piece in enumerate(pieces):
                peer.sendall(piece)
                if tick == len(pieces) - 1:
                    peer.shutdown(socket.SHUT_WR)
                controls = bridge.step(_sample(tick * TICK_US, rest))
                assert all(0.0 <= motor <= 1.0 for motor in controls.motors), controls
                answered += controls.armed
        except (FirmwareLostError, FirmwareMissingError) as error:
            assert "\n" not in str(error), error
            return f"lost after {answered} answers"
        finally:
            peer.close()
    return "all samples answered"


def meet_hostile_px4(number: int) -> str:
    """Connect to a faulty PX4; see `be_connected_to`."""
    return be_connected_to(hostile_px4(np.random.default_rng((number, 3)), 4))


CASES: Mapping[What, Callable[[int], str]] = {
    "files": read_damaged_file,
    "camera": see_hostile_frames,
    "simulator": meet_hostile_px4,
}


@dataclass(frozen=True)
class Fuzz:
    """Feed hostile files, frames and answers to their readers."""

    seconds: float = 20.0
    """Duration of each kind of test [wall s]."""
    what: tuple[What, ...] = ("files", "camera", "simulator")
    """Kinds of test."""
    first: int = 0
    """First case; its number is its seed."""


def main(asked: Fuzz) -> None:
    for what in asked.what:
        clock, number = WallClock(), asked.first
        came: Counter[str] = Counter()
        while clock.time_us() < asked.seconds * US_PER_S:
            try:
                said = CASES[what](number)
            except BaseException:
                print(f"{what} {number} broke: --what {what} --first {number}")
                raise
            came[said if what != "camera" else "companions"] += 1
            number += 1
        print(f"{what}: {number - asked.first} cases: {dict(sorted(came.items()))}", flush=True)


if __name__ == "__main__":
    os.environ.setdefault("COLUMNS", "80")
    main(tyro.cli(Fuzz))
