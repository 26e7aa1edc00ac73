"""Black box: file format, recovery after a crash, and full disks."""

from __future__ import annotations

import base64
import json
import random
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from airl_mav.addons.recordings.recorded_flight import episode_of
from airl_mav.black_box.mcap_file import BlackBoxFile, read_black_box
from airl_mav.black_box.messages import (
    CHANNELS,
    TOPICS,
    Command,
    Decision,
    End,
    Latency,
    Log,
    Phase,
    RawImage,
    Resources,
    Status,
    Telemetry,
    Truth,
    foxglove_schema,
    image_message,
    image_of,
    text,
)
from airl_mav.camera.frame import Frame, FurtherImage
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.clock import SimClock
from airl_mav.core.constants import US_PER_MS, US_PER_S
from airl_mav.core.errors import UsageError
from airl_mav.scenario.stand_alone import StandAloneCompanion
from companion.addons.black_box.recorder import BlackBoxRecorder, run_of
from companion.frame_source import ReceivedFrame
from companion.link_interface import BodyVelocity
from companion.pilot import SentDecision
from companion.program import prepare
from tests.support.full_disk import largest_file
from tests.support.processes import running, wait_until
from tests.support.recording_child import PERIOD_US, Straight

NOW_US = 1_800_000_000_000_000
RUN: dict[str, Any] = {
    "name": "flight",
    "config": {
        "goal": [20.0, 0.0],
        "seed": 1,
        "speed": 1.0,
        "pilot": {"hold_s": 0.5, "goal_radius_m": 3.0},
        "limits": {"flight_s": 600.0},
    },
}
QUATERNION = (1.0, 0.0, 0.0, 0.0)
MESSAGES: list[Any] = [
    Phase(5, "navigating"),
    Telemetry(10, (1.0, 2.0, -3.0), (0.1, 0.2, 0.3), QUATERNION),
    Decision(
        1,
        2,
        3,
        4,
        5,
        6,
        -1,
        (0.0, 0.0, None),
        (0.0, 0.0, 0.0),
        QUATERNION,
        20.0,
        (1.0, 0.0, 0.0, 0.5),
    ),
    image_message(np.arange(48 * 64, dtype=np.uint16).reshape(48, 64), NOW_US),
    Truth(15, (1.0, 2.0, -3.0), (0.1, 0.2, 0.3), QUATERNION, 250.0),
    Command(15, (1.0, 0.0, 0.0), 0.5),
    Latency(5, 1.0, 2.0, 3.0, 0.1, None, None, None, 500.0, None),
    Status(20, True, True, "offboard", 16.2, None, 0.5),
    Resources(20, 0.25, 40.0, 100_000_000, None),
    text("Landing detected", "flight controller", NOW_US),
    End(30, "goal reached", ("a note",)),
]


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    path = tmp_path / "whole.mcap"
    file = BlackBoxFile(path, RUN)
    for k, message in enumerate(MESSAGES):
        file.write(message, NOW_US + k)
    file.finish()
    return path


def test_what_was_written_is_read(whole: Path) -> None:
    box = read_black_box(whole)
    assert box.whole
    assert stat.S_IMODE(whole.stat().st_mode) == 0o600
    assert box.run == RUN
    read = [message for kind in TOPICS for message in box.messages[kind]]
    assert sorted(map(repr, read)) == sorted(map(repr, MESSAGES))
    (image,) = box.all_of(RawImage)
    np.testing.assert_array_equal(image_of(image), np.arange(48 * 64).reshape(48, 64))


def test_any_reader_of_mcap_reads_it_and_finds_its_schemas(whole: Path) -> None:
    with whole.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = {
            channel.topic: (schema, channel, message)
            for schema, channel, message in reader.iter_messages()
        }
        assert set(found) == set(TOPICS.values())
        for kind, topic in TOPICS.items():
            schema, channel, message = found[topic]
            assert schema is not None
            assert (schema.name, schema.encoding) == (CHANNELS[kind].schema_name, "jsonschema")
            assert channel.message_encoding == "json"
            properties = json.loads(schema.data)["properties"]
            assert properties.keys() == json.loads(message.data).keys()
            assert 0 <= message.log_time - 1000 * NOW_US < 1000 * len(MESSAGES)
    # Foxglove's own schemas: https://github.com/foxglove/foxglove-sdk/tree/main/schemas/jsonschema
    image = json.loads(found[TOPICS[RawImage]][2].data)
    assert image["timestamp"] == {"sec": NOW_US // US_PER_S, "nsec": 0}
    assert (image["encoding"], image["step"], image["width"], image["height"]) == (
        *("mono16", 128, 64, 48),
    )
    assert len(base64.b64decode(image["data"])) == 128 * 48
    log = json.loads(found[TOPICS[Log]][2].data)
    assert log.keys() == {"timestamp", "level", "message", "name", "file", "line"}


def test_cut_anywhere_all_whole_messages_before_are_read(whole: Path, tmp_path: Path) -> None:
    data, cut = whole.read_bytes(), tmp_path / "cut.mcap"
    counts = []
    for size in [*range(0, len(data), 97), len(data) - 1]:
        cut.write_bytes(data[:size])
        try:
            box = read_black_box(cut)
        except UsageError as error:
            assert "cut.mcap: accepted: a black box of airl-companion" in str(error)
            counts.append(-1)
            continue
        counts.append(sum(map(len, box.messages.values())))
        assert all(message in MESSAGES for kind in box.messages.values() for message in kind)
    assert counts == sorted(counts), "the longer the file, the more is read"
    assert {-1, 0, 1, len(MESSAGES)} <= set(counts)


@pytest.mark.parametrize("flips", [90, pytest.param(300, marks=pytest.mark.nightly)])
def test_flipped_bits_are_told_and_raise_nothing_else(
    whole: Path, tmp_path: Path, flips: int
) -> None:
    data, draw = whole.read_bytes(), random.Random(1)
    broken, told = tmp_path / "broken.mcap", 0
    for _ in range(flips):
        changed = bytearray(data)
        changed[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
        broken.write_bytes(changed)
        try:
            box = read_black_box(broken)
            record = episode_of(box).record
        except UsageError:
            told += 1
            continue
        told += box.damaged or not box.whole
        assert not box.damaged or "its checksum is wrong" in record.notes[-1]
    # The remaining flips are behind the records, in the index.
    assert told > 2 * flips // 3


@pytest.mark.parametrize(
    ("run", "wrong"),
    [
        ({}, "goal"),
        ({"config": []}, "config"),
        ({"config": {**RUN["config"], "goal": ["far", 0]}}, "goal"),
        ({"config": {**RUN["config"], "speed": 0}}, "speed"),
        ({"config": {**RUN["config"], "pilot": {}}}, "pilot.hold_s"),
    ],
)
def test_settings_that_are_none_are_named(run: Any, wrong: str, tmp_path: Path) -> None:
    file = BlackBoxFile(tmp_path / "flight.mcap", run)
    file.finish()
    with pytest.raises(UsageError) as error:
        episode_of(read_black_box(file.path))
    assert "flight.mcap" in str(error.value)
    assert wrong in str(error.value) or wrong == "config"


@pytest.mark.parametrize("data", [b"", b"no black box", b"\x89MCAP0\r\n"])
def test_another_file_is_refused(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    path.write_bytes(data)
    with pytest.raises(UsageError, match="accepted: a black box of airl-companion"):
        read_black_box(path)


def test_a_file_that_is_there_is_never_written_over(whole: Path) -> None:
    before = whole.read_bytes()
    with pytest.raises(FileExistsError):
        BlackBoxFile(whole, RUN)
    assert whole.read_bytes() == before


def test_on_a_full_disk_the_flight_goes_on(tmp_path: Path) -> None:
    clock = SimClock()
    path = tmp_path / "flight.mcap"
    recorder = BlackBoxRecorder(BlackBoxFile(path, RUN), Straight(clock), clock, (9.0, 0.0), 0.0)
    with largest_file(40_000):
        for _ in range(500):
            clock.advance(40 * US_PER_MS)
            recorder.record(clock.time_us())
        recorder.end("goal reached", ())
    assert recorder.failure == f"the black box ends early: {path}: File too large"
    box = read_black_box(path)
    assert not box.whole
    assert 10 < len(box.all_of(Telemetry)) < 500


@pytest.mark.parametrize(
    "k", [0, 1, *(pytest.param(k, marks=pytest.mark.nightly) for k in range(2, 50))]
)
def test_killed_at_any_moment_at_most_a_second_is_lost(k: int, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    moment_s = random.Random(k).uniform(0.6, 2.0)
    with running(["-m", "tests.support.recording_child", str(path)], tmp_path) as child:
        wait_until(lambda: len(child.text().split()) > moment_s * US_PER_S / PERIOD_US, "decisions")
        child.process.kill()
        child.process.wait()
        told = [int(word) for word in child.text().split()]
    box = read_black_box(path)
    assert not box.whole
    decisions = [decision.sent_us for decision in box.all_of(Decision)]
    assert decisions == told[: len(decisions)], "in order, none missing, none made up"
    assert told[-1] - decisions[-1] < US_PER_S
    images = box.all_of(RawImage)
    assert images and image_of(images[0])[0, 0] == 1


FOXGLOVE_TYPES = {"boolean", "string", "number", "integer", "object", "array"}
"""Property types that parseJsonSchema.ts of foxglove/studio accepts. Any other type raises an
error, and nothing of the file is shown."""


def fields_of(schema: dict[str, Any]) -> dict[str, Any]:
    """Read a schema as Foxglove's parser does: fields by their dotted names."""
    assert schema["type"] == "object"
    found: dict[str, Any] = {}
    for name, each in schema["properties"].items():
        assert each.get("type") in FOXGLOVE_TYPES, name
        inner = each["items"] if each["type"] == "array" else each
        assert inner.get("type") in FOXGLOVE_TYPES - {"array"} or each["type"] != "array", name
        if inner["type"] == "object":
            found |= {f"{name}.{key}": value for key, value in fields_of(inner).items()}
        else:
            found[name] = each["type"], inner["type"], inner.get("contentEncoding")
    return found


@pytest.mark.parametrize("kind", TOPICS)
def test_foxglove_reads_every_schema(kind: type[Any]) -> None:
    read = fields_of(foxglove_schema(kind))
    assert {name.partition(".")[0] for name in read} == set(kind.__dataclass_fields__)


def test_foxglove_knows_the_fields_that_are_no_plain_numbers() -> None:
    decision, image = fields_of(foxglove_schema(Decision)), fields_of(foxglove_schema(RawImage))
    assert decision["goal_away_m"] == ("number", "number", None)
    assert decision["position"] == ("array", "number", None)
    assert image["data"] == ("string", "string", "base64")
    assert image["timestamp.nsec"] == ("integer", "integer", None)


def test_a_latency_that_was_asked_for_is_written_with_the_rest(tmp_path: Path) -> None:
    asked = StandAloneCompanion(
        policy="greedy", goal=(9.0, 0.0), latency="lognormal:150ms,20ms", black_box=tmp_path
    )
    file = BlackBoxFile(tmp_path / "flight.mcap", run_of(asked, prepare(asked)))
    file.finish()
    setup = read_black_box(file.path).run["setup"]
    assert setup["injection"]["latency"]["mean_ms"] == 150.0


def test_images_of_further_cameras_have_topics_of_their_own(tmp_path: Path) -> None:
    clock, path = SimClock(1_000_000), tmp_path / "flight.mcap"
    recorder = BlackBoxRecorder(BlackBoxFile(path, RUN), Straight(clock), clock, (9.0, 0.0), 10.0)
    depth = np.arange(6, dtype=np.uint16).reshape(2, 3)
    grey = np.arange(8, dtype=np.uint8).reshape(2, 4, 1)
    lenses = Intrinsics(3, 2, 1.5, 1.0, 0.5), Intrinsics(4, 2, 2.0, 1.5, 0.5, kind="grey")
    down = FurtherImage(grey, lenses[1])
    frame = Frame(1, 990_000, depth, lenses[0], further={"down": down})
    now_us = clock.time_us()
    seen, state = ReceivedFrame(frame, now_us), Straight(clock).kinematics()
    times = (now_us, now_us, now_us, now_us, now_us)
    recorder.decided(
        SentDecision(seen, state, BodyVelocity(1.0, 0.0, 0.0, 0.0), *times, None, depth)
    )
    recorder.end("goal reached", ())
    with path.open("rb") as file:
        read = make_reader(file, validate_crcs=True).iter_messages()
        images = {channel.topic: json.loads(message.data) for _, channel, message in read}
    assert images["/depth/down"]["frame_id"] == "down"
    assert images["/depth/down"]["encoding"] == "mono8"
    assert base64.b64decode(images["/depth/down"]["data"]) == bytes(range(8))
    assert base64.b64decode(images["/depth"]["data"]) == depth.tobytes()
    # The file read as a flight contains the main camera's images.
    box = read_black_box(path)
    assert box.whole
    (image,) = box.all_of(RawImage)
    np.testing.assert_array_equal(image_of(image), depth)
