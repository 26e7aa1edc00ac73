"""`airl export-log`: real flights, written, and read by the programs that shall read them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from pyulog import ULog
from scipy.spatial.transform import Rotation, Slerp

from airl_mav import Scenario, rehearse
from airl_mav.addons.export_log.command import flight_of
from airl_mav.addons.export_log.recorded import RecordedFlight
from airl_mav.addons.export_log.ulog_log import samples, write_ulog
from airl_mav.addons.recordings.recorded_flight import episode_of
from airl_mav.addons.view.replayed_flight import ReplayedRun
from airl_mav.arena.generate import generate
from airl_mav.black_box.mcap_file import BlackBoxFile, read_black_box
from airl_mav.black_box.messages import Decision, End, Latency, Phase, Telemetry
from airl_mav.cli import options as cli_options
from airl_mav.core.errors import UsageError
from airl_mav.flight.judge import Outcome
from airl_mav.latency.stamps import STAMPS
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile
from airl_mav.rehearsal.run_folder import LoadedRun, load
from firmware_sim.addons.flight_log.topics import TOPICS
from tests.support.command_line import airl, option_words
from tests.support.flown_here import flown_here
from tests.support.lenses import angles
from tests.support.mcap_kit import ReadMcap, distances_to, protobuf_kind, read_mcap, turn_of, xyz
from tests.support.processes import ROOT

ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])


def fly(out: Path, *words: str, **asked: Any) -> Path:
    code, _ = airl("evaluate", "greedy", *words, *option_words(out=out, **asked))
    assert code == 0
    return out


@pytest.fixture(scope="module")
def gym(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("gym") / "run"
    asked: dict[str, Any] = {"arena": "dynamic-obstacles", "episodes": 2, "seed": 3}
    return fly(out, "--wind.east-m-s", "2", latency="200ms", **asked)


@pytest.fixture(scope="module")
def lockstep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("lockstep") / "run"
    asked: dict[str, Any] = {"arena": "static-obstacles", "episodes": 1, "time_limit_s": 6.0}
    with flown_here():
        return fly(out, level="lockstep", workers=1, tlogs=True, **asked)


@pytest.fixture(scope="module", params=["gym", "lockstep"])
def flown(request: pytest.FixtureRequest) -> LoadedRun:
    return load(request.getfixturevalue(request.param))


@pytest.fixture(scope="module")
def exported(flown: LoadedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("foxglove", reason="needs the [export] extra")
    out = tmp_path_factory.mktemp("mcap")
    code, text = airl("export_log", str(flown.path), "0", "--out", str(out))
    assert code == 0
    assert text.startswith(str(out / "flight-000.mcap"))
    assert [path.name for path in out.iterdir()] == ["flight-000.mcap"]
    return out / "flight-000.mcap"


@pytest.fixture(scope="module")
def told(exported: Path) -> ReadMcap:
    return read_mcap(exported)


def recorded(run: Path, index: int = 0) -> RecordedFlight:
    return flight_of(ReplayedRun(run), index)


# --- MCAP


def test_every_pose_is_that_of_the_recording(flown: LoadedRun, told: ReadMcap) -> None:
    path, arrays = flown.trajectories[0], flown.latency[0]
    began_ns = told.messages["/tf"][0][0] - 1000 * int(path.time_us[0])
    sources: dict[str, Any] = {"/tf": path.arrays()}
    if flown.info.setup.level == "lockstep":
        names = ("time_us", "position", "quaternion")
        sources["/tf_estimate"] = {name: arrays[f"estimate/{name}"] for name in names}
    assert ("/tf_estimate" in told.messages) == ("/tf_estimate" in sources)
    for topic, source in sources.items():
        poses = [message.transforms[0] for message in told.of(topic)]
        times = np.array([time_ns for time_ns, _ in told.messages[topic]])
        np.testing.assert_array_equal(times - began_ns, 1000 * source["time_us"])
        assert {pose.parent_frame_id for pose in poses} == {"world"}
        places = np.array([xyz(pose.translation) for pose in poses])
        np.testing.assert_allclose(places, source["position"] @ ENU_FROM_NED.T, atol=1e-12)
        w, x, y, z = source["quaternion"].T
        turns = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
        expected = ENU_FROM_NED @ turns @ FLU_FROM_FRD
        found = np.array([turn_of(pose.rotation).as_matrix() for pose in poses])
        np.testing.assert_allclose(found, expected, atol=1e-9)


FISHEYE = """
base = "quad"
description = "a fisheye with coefficients"
[camera]
projection = "fisheye"
width_px = 48
height_px = 48
horizontal_fov_deg = 150.0
distortion = [-0.05, 0.008, -0.0045, 0.0004]
"""


@pytest.mark.nightly
def test_a_fisheye_is_calibrated_as_one(tmp_path: Path) -> None:
    """Every pixel, led through calibration as OpenCV has it, ends where the arena is."""
    pytest.importorskip("foxglove", reason="needs the [export] extra")
    vehicle = tmp_path / "wide.toml"
    vehicle.write_text(FISHEYE, encoding="utf-8")
    # In lockstep: the twin with a fisheye is compiled for half a minute.
    asked: dict[str, Any] = {"arena": "no-obstacles", "episodes": 1, "time_limit_s": 4.0}
    asked |= {"level": "lockstep", "start": "hover"}
    run = fly(tmp_path / "run", vehicle=str(vehicle), **asked)
    airl("export_log", str(run), "0", "--out", str(tmp_path / "log"))
    told = read_mcap(tmp_path / "log" / "flight-000.mcap")
    (calibration,) = told.of("/camera/calibration")
    assert calibration.distortion_model == "kannala_brandt"
    assert list(calibration.D) == [-0.05, 0.008, -0.0045, 0.0004]
    f, _, cx, _, _, cy, *_ = calibration.K
    image = told.of("/camera/depth")[0]
    depth = np.frombuffer(image.data, "<u2").reshape(image.height, image.width) / 1000.0
    v, u = np.nonzero(depth)
    out = np.hypot(u - cx, v - cy) / f
    off = angles(out, (-0.05, 0.008, -0.0045, 0.0004))
    # Level at the beginning, above the floor: by the range along the ray.
    below = depth[v, u] * np.sin(off) * (v - cy) / f / out
    flat = below[below > 0.98 * below.max()]
    assert len(flat) > 0.3 * len(below)
    assert flat.std() < 0.02


def test_what_the_camera_saw_lies_on_the_bodies_of_the_scene(
    flown: LoadedRun, told: ReadMcap
) -> None:
    """Every pixel, led through calibration and transforms, ends on a wall or an obstacle."""
    (calibration,) = told.of("/camera/calibration")
    f, _, cx, _, _, cy, *_ = calibration.K
    tf_ns = np.array([time_ns for time_ns, _ in told.messages["/tf"]])
    places = np.array([xyz(each.transforms[0].translation) for each in told.of("/tf")])
    turns = Slerp(
        tf_ns, Rotation.concatenate([turn_of(e.transforms[0].rotation) for e in told.of("/tf")])
    )
    camera = told.of("/tf")[0].transforms[1]
    assert (camera.parent_frame_id, camera.child_frame_id) == ("vehicle", "camera")
    movers_ns = np.array([time_ns for time_ns, _ in told.messages["/scene/movers"]])
    images = told.messages["/camera/depth"]
    captured = flown.latency[0]["capture_us"]
    assert len(images) == len(np.unique(captured[flown.latency[0]["sent_us"] >= 0]))
    seen, moving = 0, 0
    for time_ns, image in images[:: max(1, len(images) // 12)]:
        assert image.frame_id == "camera"
        depth = np.frombuffer(image.data, "<u2").reshape(image.height, image.width) / 1000.0
        v, u = np.nonzero(depth)
        z = depth[v, u]
        optical = np.stack([(u - cx) / f * z, (v - cy) / f * z, z], axis=1)
        body = turn_of(camera.rotation).apply(optical) + xyz(camera.translation)
        at = [np.interp(time_ns, tf_ns, column) for column in places.T]
        world = turns(time_ns).apply(body) + at
        away = distances_to(told.of("/scene/arena")[0], world)
        if len(movers_ns):
            scene = told.of("/scene/movers")[int(np.argmin(np.abs(movers_ns - time_ns)))]
            # Movers are logged at 10 Hz, and fly at up to 2.5 m/s.
            other = distances_to(scene, world)
            moving += int(np.sum((other < 0.15) & (away > 0.15)))
            away = np.where(other < 0.15, 0.0, away)
        assert away.max() < 0.03
        seen += len(z)
    assert seen > 1000
    assert bool(moving) == bool(len(movers_ns))


def test_hills_are_in_the_scene_and_the_goal_stands_on_them() -> None:
    pytest.importorskip("foxglove")
    from foxglove.messages import Timestamp

    from airl_mav.addons.export_log.scene import arena_scene

    spec = load_profile("arenas", "hills", ArenaSpec)
    arenas = (generate(spec, seed, name="hills", vehicle_width_m=0.6) for seed in range(30))
    # An arena with its goal on a hill.
    arena = next(each for each in arenas if each.ground and each.ground.height_at(*each.goal) > 0.3)
    ground = arena.ground
    assert ground is not None
    told = arena_scene(arena, arena.goal_point, 3.0, Timestamp(0, 0))
    schema = told.get_schema()
    scene = protobuf_kind(schema.name, schema.data).FromString(told.encode())
    entities = {entity.id: entity for entity in scene.entities}
    (surface,) = entities["ground"].triangles
    places = np.array([[point.x, point.y, point.z] for point in surface.points])
    np.testing.assert_allclose(places, ground.points @ ENU_FROM_NED.T, atol=1e-9)
    np.testing.assert_array_equal(np.reshape(surface.indices, (-1, 3)), ground.faces)
    disc, pole, _ = entities["goal"].cylinders
    below = ground.height_at(*arena.goal.tolist())
    assert disc.pose.position.z == pytest.approx(below + 0.02)
    assert pole.pose.position.z - 0.5 * pole.size.z == pytest.approx(below)


def test_arrows_and_the_path_are_those_of_the_recording(flown: LoadedRun, told: ReadMcap) -> None:
    path = flown.trajectories[0]
    shown = told.of("/scene/velocity")
    assert len(shown) == -(-len(path) // 5)
    drawn = 0
    for i, update in enumerate(shown):
        (entity,) = update.entities
        velocity = ENU_FROM_NED @ path.velocity[5 * i]
        length = 0.6 * np.linalg.norm(velocity)
        if length < 0.1:
            continue
        flown_arrow = entity.arrows[0]
        along = turn_of(flown_arrow.pose.orientation).apply([1.0, 0.0, 0.0])
        np.testing.assert_allclose(along * length, 0.6 * velocity, atol=1e-9)
        assert flown_arrow.shaft_length + flown_arrow.head_length == pytest.approx(length)
        np.testing.assert_allclose(
            xyz(flown_arrow.pose.position), ENU_FROM_NED @ path.position[5 * i], atol=1e-9
        )
        drawn += 1
    assert drawn > 10
    (line,) = told.of("/scene/path")[0].entities[0].lines
    way = turn_of(line.pose.orientation).apply([xyz(point) for point in line.points])
    np.testing.assert_allclose(way[0], ENU_FROM_NED @ path.position[0], atol=1e-9)
    assert np.linalg.norm(way[-1] - ENU_FROM_NED @ path.position[-1]) < 0.06
    # The nose is ahead, the rotors are above.
    (body,) = told.of("/scene/vehicle")[0].entities
    assert (body.frame_id, body.frame_locked) == ("vehicle", True)
    assert body.cubes[1].pose.position.x > 0.0
    assert len(body.cylinders) == 4
    assert min(rotor.pose.position.z for rotor in body.cylinders) > 0.0


def test_the_numbers_are_those_of_the_run(flown: LoadedRun, told: ReadMcap, exported: Path) -> None:
    path, arrays, record = flown.trajectories[0], flown.latency[0], flown.episodes[0]
    sent = arrays["sent_us"] >= 0
    box = read_black_box(exported)
    assert box.whole
    assert not box.damaged
    decisions = box.all_of(Decision)
    for name in STAMPS:
        assert [getattr(each, name) for each in decisions] == arrays[name][sent].tolist()
    np.testing.assert_allclose(
        np.array([each.setpoint for each in decisions]), arrays["setpoint"][sent]
    )
    latencies = box.all_of(Latency)
    took_ms = (arrays["motor_us"] - arrays["capture_us"])[sent] / 1e3
    known = arrays["motor_us"][sent] >= 0
    told_ms = [each.end_to_end_ms for each in latencies]
    assert [ms is not None for ms in told_ms] == known.tolist()
    np.testing.assert_allclose([ms for ms in told_ms if ms is not None], took_ms[known])
    np.testing.assert_allclose(
        [each["position"] for each in told.of("/truth")], path.position, atol=1e-9
    )
    np.testing.assert_allclose([each["power_w"] for each in told.of("/truth")], path.power_w)
    # Commands are in the heading frame; a turn about the vertical brings them into the world.
    command = told.of("/command")[-1]
    newest = int(np.flatnonzero(arrays["sent_us"][sent] <= command["time_us"])[-1])
    at = int(np.searchsorted(path.time_us, command["time_us"]))
    w, x, y, z = path.quaternion[at]
    heading = Rotation.from_quat([x, y, z, w]).as_euler("ZYX")[0]
    expected = Rotation.from_euler("Z", heading).apply(arrays["setpoint"][sent][newest][:3])
    np.testing.assert_allclose(command["velocity"], expected, atol=1e-6)
    texts = [each["message"] for each in told.of("/log")]
    assert f"{record.outcome.value}: {record.reason}" in texts
    assert json.loads(told.metadata["airl-mav"]["run"])["setup"]["level"] == flown.info.setup.level


def test_viewers_can_jump_to_any_time(told: ReadMcap) -> None:
    assert told.chunks >= 1
    assert told.schemas["/tf"] == "foxglove.FrameTransforms"
    assert told.schemas["/scene/arena"] == "foxglove.SceneUpdate"
    assert told.schemas["/camera/depth"] == "foxglove.RawImage"
    assert told.schemas["/camera/calibration"] == "foxglove.CameraCalibration"
    assert told.schemas["/log"] == "foxglove.Log"
    # Static content must not share its topic with repeated messages.
    for topic in ("/scene/arena", "/scene/path", "/scene/vehicle"):
        assert len(told.of(topic)) == 1
    for topic, messages in told.messages.items():
        assert [time_ns for time_ns, _ in messages] == sorted(t for t, _ in messages), topic


def test_an_exported_flight_reads_as_a_black_box(flown: LoadedRun, exported: Path) -> None:
    record, again = flown.episodes[0], episode_of(read_black_box(exported))
    assert (again.record.seed, again.record.goal) == (record.seed, record.goal)
    assert (again.record.outcome is Outcome.SUCCESS) == (record.outcome is Outcome.SUCCESS)
    assert again.record.navigation_us == record.navigation_us
    assert abs(again.record.ended_us - record.ended_us) <= 20_000
    sent = flown.latency[0]["sent_us"] >= 0
    np.testing.assert_array_equal(again.latency["sent_us"], flown.latency[0]["sent_us"][sent])


def test_the_black_box_of_a_real_flight_is_exported_without_a_truth(
    flown: LoadedRun, exported: Path, tmp_path: Path
) -> None:
    box, real = read_black_box(exported), tmp_path / "real.mcap"
    setup = {**box.run["setup"], "level": "flight"}
    file = BlackBoxFile(real, {**box.run, "setup": setup})
    kinds: tuple[Any, ...] = (Phase, Telemetry, Decision, End)
    for kind in kinds:
        for i, message in enumerate(box.all_of(kind)):
            file.write(message, i)
    file.finish()
    code, _ = airl("export_log", str(real))
    assert code == 0
    told = read_mcap(tmp_path / "real" / "flight-000.mcap")
    assert len(told.of("/decision")) == len(box.all_of(Decision))
    assert {"/truth", "/tf_estimate", "/camera/depth", "/scene/movers"}.isdisjoint(told.messages)
    places = np.array([xyz(each.transforms[0].translation) for each in told.of("/tf")])
    heard = np.array([each.position for each in box.all_of(Telemetry)])
    np.testing.assert_allclose(places, heard @ ENU_FROM_NED.T, atol=1e-9)
    assert all(each["voltage_v"] is None for each in told.of("/status"))


def test_rerun_opens_it(flown: LoadedRun, exported: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is 500 MB: install it by hand")
    rows: dict[str, int] = {}
    components: dict[str, set[str]] = {}
    for each in chunk.McapReader(exported).stream():
        columns = set(each.to_record_batch().schema.names)
        components.setdefault(each.entity_path, set()).update(columns)
        if any("Transform3D" in name or "Image" in name for name in columns):
            rows[each.entity_path] = rows.get(each.entity_path, 0) + each.num_rows
    # A row for each of the two transforms of a pose.
    assert rows["/tf"] == 2 * len(flown.trajectories[0])
    assert any("Transform3D:quaternion" in name for name in components["/tf"])
    assert any("Pinhole" in name for name in components["/camera/calibration"])
    assert rows["/camera/depth"] > 0


# --- ULog


def interpolated(log: ULog, topic: str, name: str, times_us: np.ndarray) -> np.ndarray:
    data = log.get_dataset(topic).data
    return np.interp(times_us, data["timestamp"], data[name])


def test_a_flight_of_level_gym_has_px4s_topics(gym: Path, tmp_path: Path) -> None:
    run = load(gym)
    code, text = airl("export_log", str(gym), "--format", "ulog", "--out", str(tmp_path))
    assert code == 0
    assert len(text.splitlines()) == 2
    for index, record in enumerate(run.episodes):
        log, path = ULog(str(tmp_path / f"flight-{index:03d}.ulg")), run.trajectories[index]
        assert not log.file_corruption
        truth = log.get_dataset("vehicle_local_position_groundtruth").data
        rows = np.searchsorted(path.time_us, truth["timestamp"])
        for column, name in enumerate(("x", "y", "z")):
            np.testing.assert_allclose(truth[name], path.position[rows, column], atol=1e-4)
            np.testing.assert_allclose(truth[f"v{name}"], path.velocity[rows, column], atol=1e-4)
        turned = log.get_dataset("vehicle_attitude_groundtruth").data
        rows = np.searchsorted(path.time_us, turned["timestamp"])
        for part in range(4):
            np.testing.assert_allclose(turned[f"q[{part}]"], path.quaternion[rows, part], atol=1e-6)
        # Remaining battery of the simulator at the end, recomputed from power and time.
        battery = log.get_dataset("battery_status").data
        assert record.battery_remaining is not None
        last_us = int(battery["timestamp"][-1])
        used, share = 1.0 - record.battery_remaining, last_us / record.ended_us
        assert battery["remaining"][-1] == pytest.approx(1.0 - used * share, abs=0.05 * used)
        setpoint = log.get_dataset("trajectory_setpoint").data
        speeds = np.hypot(setpoint["velocity[0]"], setpoint["velocity[1]"])
        asked = run.latency[index]["setpoint"]
        assert np.isfinite(speeds).all()
        assert speeds.max() <= np.hypot(asked[:, 0], asked[:, 1]).max() + 1e-4
        assert np.isnan(setpoint["position[0]"]).all()
        assert set(log.get_dataset("vehicle_status").data["nav_state"].tolist()) <= {4, 14}
        texts = [each.message for each in log.logged_messages]
        assert texts[-1] == f"{record.outcome.value}: {record.reason}"
        assert not list(tmp_path.glob("*.part"))


def test_a_flight_that_began_before_its_clock_is_later_by_as_much(
    gym: Path, tmp_path: Path
) -> None:
    """Export a flight on the clock of a companion that started later, as with a vehicle's log."""
    flight = recorded(gym)
    path = flight.replayed.path
    earlier = replace(path, time_us=path.time_us - 5_000_000)
    write_ulog(replace(flight, replayed=replace(flight.replayed, path=earlier)), tmp_path / "x.ulg")
    log = ULog(str(tmp_path / "x.ulg"))
    assert log.start_timestamp == 0 and not log.file_corruption
    truth = log.get_dataset("vehicle_local_position_groundtruth").data
    np.testing.assert_array_equal(truth["timestamp"], truth["timestamp_sample"])
    rows = np.searchsorted(earlier.time_us, truth["timestamp"].astype(np.int64) - 5_000_000)
    assert len(rows) > 10
    np.testing.assert_allclose(truth["x"], path.position[rows, 0], atol=1e-4)
    said_us = log.logged_messages[-1].timestamp
    assert said_us == flight.replayed.record.ended_us + 5_000_000


def test_body_rates_and_attitudes_have_px4s_topics(tmp_path: Path) -> None:
    """Compare a lockstep flight with the log of its flight controller."""
    policy = f"{ROOT / 'examples' / 'own_body_rates.py'}:ToGoal"
    scenario = Scenario(policy=policy, arena="no-obstacles", level="lockstep", tlogs=True)
    rehearse(scenario, out=tmp_path / "run")
    flight = recorded(tmp_path / "run")
    rows = {topic: (times_us, values) for topic, times_us, values in samples(flight)}
    assert "trajectory_setpoint" not in rows and "vehicle_attitude_setpoint" not in rows
    times_us, values = rows["vehicle_rates_setpoint"]
    made = np.column_stack(
        [times_us, *(values[name] for name in ("roll", "pitch", "yaw", "thrust_body"))]
    )
    own = ULog(str(tmp_path / "run" / "flight-000.ulg")).get_dataset("vehicle_rates_setpoint").data
    # They are followed after half a second; later both are the newest, one tick apart at most.
    later = made[made[:, 0] > made[0, 0] + 600_000]
    assert len(later) > 200
    names = ("roll", "pitch", "yaw", "thrust_body[0]", "thrust_body[1]", "thrust_body[2]")
    newest = np.searchsorted(own["timestamp"], later[:, 0], side="right") - 1
    for column, name in enumerate(names, start=1):
        near = np.abs(later[:, column] - own[name][newest]) < 1e-5
        near |= (
            np.abs(later[:, column] - own[name][(newest + 1).clip(max=len(own[name]) - 1)]) < 1e-5
        )
        assert near.mean() > 0.9, name
    # The same numbers as an attitude: PX4's quaternion, as scipy turns it.
    stamps = dict(flight.replayed.stamps)
    stamps["attitude_setpoint"] = stamps.pop("rates_setpoint")
    leaning = replace(flight, replayed=replace(flight.replayed, stamps=stamps))
    ((times_us, values),) = (
        each[1:] for each in samples(leaning) if each[0] == "vehicle_attitude_setpoint"
    )
    assert len(times_us) > 100
    sent = np.searchsorted(stamps["sent_us"], times_us, side="right") - 1
    roll, pitch, yaw, thrust = stamps["attitude_setpoint"][sent].astype(float).T
    turned = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1))
    apart = Rotation.from_quat(values["q_d"], scalar_first=True) * turned.inv()
    assert apart.magnitude().max() < 1e-6
    np.testing.assert_allclose(values["thrust_body"][:, 2], -thrust)


def test_the_vehicles_own_log_is_taken_where_there_is_one(lockstep: Path, tmp_path: Path) -> None:
    own = (lockstep / "flight-000.ulg").read_bytes()
    for out in (tmp_path, lockstep):
        code, _ = airl("export_log", str(lockstep), "--format", "ulog", "--out", str(out))
        assert code == 0
        assert (out / "flight-000.ulg").read_bytes() == own


def test_a_made_log_agrees_with_the_vehicles_own(lockstep: Path, tmp_path: Path) -> None:
    without = tmp_path / "run"
    shutil.copytree(lockstep, without, ignore=shutil.ignore_patterns("*.ulg"))
    assert airl("export_log", str(without), "--format", "ulog")[0] == 0
    own, made = (ULog(str(folder / "flight-000.ulg")) for folder in (lockstep, without))
    for topic, names, close in (
        ("vehicle_local_position_groundtruth", ("x", "y", "z", "vx", "vy", "vz"), 0.05),
        ("vehicle_local_position", ("x", "y", "z", "vx", "vy", "vz", "heading"), 0.05),
        ("vehicle_attitude", ("q[0]", "q[1]", "q[2]", "q[3]"), 0.01),
        ("battery_status", ("remaining",), 0.002),
    ):
        times = made.get_dataset(topic).data["timestamp"]
        times = times[times <= own.get_dataset(topic).data["timestamp"][-1]]
        assert len(times) > 20
        for name in names:
            theirs, ours = (interpolated(log, topic, name, times) for log in (own, made))
            # Both are sampled at 5 to 25 Hz, some milliseconds apart: at the start of the climb a
            # line between two samples is not the flight.
            assert np.quantile(np.abs(theirs - ours), 0.95) < close, (topic, name)


def test_a_flight_without_truth_has_no_groundtruth(gym: Path) -> None:
    flight = recorded(gym)
    outside = replace(
        flight, info=replace(flight.info, setup=replace(flight.info.setup, level="flight"))
    )
    assert outside.truth is None
    topics = {topic for topic, _, _ in samples(outside)}
    assert "vehicle_local_position" in topics
    assert not [name for name in topics if name.endswith("groundtruth") or "battery" in name]


def test_a_row_knows_its_fields() -> None:
    (attitude,) = (each.topic for each in TOPICS if each.topic.name == "vehicle_attitude")
    with pytest.raises(ValueError, match="altitude"):
        attitude.rows([1, 2], {"altitude": 3.0})
    with pytest.raises(ValueError, match="shape"):
        attitude.rows([1], {"q": [1.0, 0.0, 0.0]})


# --- what cannot be done


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["7"], "FLIGHTS 7: accepted: 0 to 1, as far as recorded"),
        (["--format", "csv"], None),
    ],
)
def test_bad_words_are_one_line(
    gym: Path, words: list[str], line: str | None, tmp_path: Path
) -> None:
    pytest.importorskip("foxglove", reason="needs the [export] extra")
    with pytest.raises((UsageError, SystemExit)) as caught:
        airl("export_log", str(gym), *words, "--out", str(tmp_path))
    assert line is None or str(caught.value) == line
    assert not list(tmp_path.iterdir())


def test_what_is_not_installed_is_one_line(gym: Path, tmp_path: Path) -> None:
    with patch.object(cli_options, "find_spec", lambda name: None if name == "foxglove" else name):
        with pytest.raises(UsageError, match=r"pip install 'airl-mav\[export\]'"):
            airl("export_log", str(gym), "--out", str(tmp_path))
        # PX4's format needs nothing more.
        words = ("0", "--format", "ulog", "--out", str(tmp_path))
        assert airl("export_log", str(gym), *words)[0] == 0


def test_a_folder_that_is_a_file_is_one_line(gym: Path, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.touch()
    with pytest.raises(UsageError, match=f"--out {taken}: File exists"):
        airl("export_log", str(gym), "--format", "ulog", "--out", str(taken))


def test_a_full_disk_leaves_what_was_there(gym: Path, tmp_path: Path) -> None:
    from tests.support.full_disk import largest_file

    path = tmp_path / "flight-000.ulg"
    path.write_bytes(b"before")
    with largest_file(4096), pytest.raises(OSError, match="File too large"):
        write_ulog(recorded(gym), path)
    assert path.read_bytes() == b"before"
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
