"""Environment steps per second on one core: vectorized simulator and other drone simulators.

    python benchmarks/bench_envs.py [--crazyflow-python P] [--pyflyt-python P] [--gpd P]

A thousand vehicles fly random velocity setpoints, a new one each step: 20 ms of flight a step
without a camera, 100 ms and a 64x48 depth image with one. Times are processor times. Each number is
the best of several stretches, as other processes only slow it down.

Each other simulator runs in a Python interpreter with that simulator installed (`pip install
crazyflow`, `pip install PyFlyt`, gym-pybullet-drones from its repository). Each uses its own
vehicle, rigid body, velocity or position controller and physics rate. All are pinned to one core.
crazyflow and this project fly a thousand vehicles in one call. PyFlyt and gym-pybullet-drones fly
one at a time. Compare "flight s/s": seconds of flight of all vehicles per second of computing.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

N = 1000
STEP_S = 0.02
"""A step without camera [s]."""
CAMERA_STEP_S = 0.1
"""A step with camera [s]."""
WIDTH, HEIGHT = 64, 48
OBSTACLES = 10
STRETCHES = 6

Result = dict[str, Any]


def result(name: str, step_s: float, hz: float, steps: float, seconds: float) -> Result:
    """Return one row for a number of environment steps in a number of seconds."""
    rate = steps / seconds
    return {"name": name, "step_s": step_s, "hz": hz, "steps": rate, "ticks": rate * step_s * hz}


def fastest(
    stretch: Callable[[], tuple[float, float]], repeats: int = STRETCHES
) -> tuple[float, float]:
    """Return steps and seconds of the fastest stretch; the first one warms up."""
    stretch()
    return min((stretch() for _ in range(repeats)), key=lambda s: s[1] / s[0])


class Row(NamedTuple):
    """One row for this project: name, seconds of flight per step, and measured function."""

    name: str
    step_s: float
    stretch: Callable[[], tuple[float, float]]


def in_turn(rows: Sequence[Row], hz: float) -> list[Result]:
    """Return the fastest stretch of each row, taken in turn: all see the same host."""
    for row in rows:
        row.stretch()
    turns = [[row.stretch() for row in rows] for _ in range(STRETCHES)]
    best = [min(stretches, key=lambda s: s[1] / s[0]) for stretches in zip(*turns, strict=True)]
    return [result(row.name, row.step_s, hz, *each) for row, each in zip(rows, best, strict=True)]


# --- ours


def measure_ours() -> list[Result]:
    from airl_mav.arena.generate import generate
    from airl_mav.camera.intrinsics import Intrinsics
    from airl_mav.camera.projection import lens_of
    from airl_mav.camera.render import Mount
    from airl_mav.core.constants import TICK_S, TICK_US
    from airl_mav.envs.arena_batch import batch_of
    from airl_mav.envs.cameras import Eye, render_images
    from airl_mav.envs.fleet import FlightStatus, Rules, hover, new_fleet, vehicle_of
    from airl_mav.envs.fleet_step import advance
    from airl_mav.profiles.arena import ArenaSpec
    from airl_mav.profiles.loading import load_profile
    from airl_mav.profiles.vehicle import VehicleProfile
    from firmware_sim.autopilot.parameter_store import Parameters

    profile = load_profile("vehicles", "quad", VehicleProfile)
    vehicle = vehicle_of(profile, Parameters(profile.parameters).__getitem__)
    rules = Rules(goal_radius=0.0, time_limit_us=10**12)
    lens = lens_of(Intrinsics.from_fov(WIDTH, HEIGHT, np.deg2rad(87.0)), 20.0)
    mount = Mount((0.1, 0.0, 0.0), 0.0)

    def bare(name: str, arena: str, step_s: float, camera: bool) -> Row:
        spec = load_profile("arenas", arena, ArenaSpec)
        worlds = [generate(spec, s, name=arena, vehicle_width_m=0.55) for s in range(200)]
        if arena != "no-obstacles":
            worlds = [w for w in worlds if len(w.obstacles) == OBSTACLES]
        arenas = batch_of([worlds[i % len(worlds)] for i in range(N)])
        fleet, rng = new_fleet(N), np.random.default_rng(0)
        ticks = np.full(N, round(step_s / TICK_S))
        images = np.zeros((N, HEIGHT, WIDTH), np.uint16)

        def stretch() -> tuple[float, float]:
            seconds = 0.0
            for i in range(N):
                hover(fleet, i, 2.5, vehicle)
            for _ in range(10 if camera else 100):
                fleet.setpoint[:] = rng.uniform([-1, -1, -0.3, -1.5], [3, 1, 0.3, 1.5], (N, 4))
                fleet.repeat_us[:] = fleet.time_us
                start = time.process_time()
                advance(fleet, arenas, ticks, vehicle, rules, None)
                if camera:
                    render_images(
                        fleet,
                        arenas,
                        fleet.verdict == FlightStatus.FLYING,
                        Eye(mount, lens, images, None),
                    )
                seconds += time.process_time() - start
            # Only what was flown counts: some touch an obstacle before the stretch is over.
            return float(fleet.time_us.sum()) / (TICK_US * ticks[0]), seconds

        return Row(name, step_s, stretch)

    def whole(arena: str, kind: str) -> Row:
        """The vector environment as a learner sees it: delays, images, rewards, new arenas."""
        from airl_mav.envs.spec import spec_of
        from airl_mav.envs.vector import NavigationVectorEnv

        knobs = {"camera": {"kind": kind}, "image_width_px": WIDTH, "image_height_px": HEIGHT}
        hold = {"hold_s": CAMERA_STEP_S}
        spec = spec_of(
            None, {"arena": arena, "episode": hold, **(knobs if kind != "depth" else {})}
        )
        env = NavigationVectorEnv(N, spec)
        env.reset(seed=1)
        rng = np.random.default_rng(0)

        def stretch() -> tuple[float, float]:
            start = time.process_time()
            for _ in range(20):
                env.step(rng.integers(0, 25, N))
            return 20.0 * N, time.process_time() - start

        same = "the same as a Gymnasium VectorEnv"
        if kind != "depth":
            same = f"Gymnasium VectorEnv, {kind}, {WIDTH}x{HEIGHT} to the network"
        return Row(f"airl-mav, {same}", CAMERA_STEP_S, stretch)

    some = "dynamic-obstacles"
    return in_turn(
        [
            bare("airl-mav, empty room", "no-obstacles", STEP_S, False),
            bare(f"airl-mav, {OBSTACLES} obstacles, some moving", some, STEP_S, False),
            bare(f"airl-mav, {OBSTACLES} obstacles, depth", some, CAMERA_STEP_S, True),
            whole(some, "depth"),
            whole(some, "rgb"),
            whole(some, "grey"),
        ],
        1.0 / TICK_S,
    )


# --- the others: run by their own interpreters


def measure_crazyflow() -> list[Result]:
    import jax
    from crazyflow.control import Control
    from crazyflow.dynamics import Dynamics
    from crazyflow.sim import Sim
    from crazyflow.sim.sensors.depth import build_render_depth_fn

    hz = 250
    rng = np.random.default_rng(0)

    def simulator(n: int, scene: Path | None) -> Sim:
        return Sim(n_worlds=n, dynamics=Dynamics.first_principles, control=Control.state, freq=hz,
                  state_freq=hz, attitude_freq=hz, body_rate_freq=hz, force_torque_freq=hz,
                  xml_path=scene)  # fmt: skip

    def setpoints(n: int) -> np.ndarray:
        """Full states, as its controller takes them: here a place near the start, a velocity."""
        wanted = np.zeros((n, 1, 16), np.float32)
        wanted[..., 0:3] = rng.uniform([-1, -1, 1], [1, 1, 2], (n, 1, 3))
        wanted[..., 3:6] = rng.uniform(-1, 1, (n, 1, 3))
        wanted[..., 12] = 1.0
        return wanted

    def measure(name: str, n: int, steps: int, step_s: float, scene: Path | None) -> Result:
        sim = simulator(n, scene)
        see = scene and build_render_depth_fn(sim.mjx_model, camera=1, resolution=(WIDTH, HEIGHT))

        def stretch() -> tuple[float, float]:
            sim.reset()
            plans = [setpoints(n) for _ in range(steps)]
            start = time.process_time()
            for wanted in plans:
                sim.state_control(wanted)
                sim.step(round(step_s * hz))
                if see:
                    jax.block_until_ready(see(sim))
            jax.block_until_ready(sim.data)
            return n * steps, time.process_time() - start

        return result(name, step_s, hz, *fastest(stretch, 3))

    rows = [measure("crazyflow, nothing but the vehicle", N, 20, STEP_S, None)]
    geoms = "".join(
        f'<geom type="{("box", "cylinder", "sphere")[i % 3]}" size="0.8 0.8 0.8" '
        f'pos="{rng.uniform(-20, 20):.2f} {rng.uniform(-20, 20):.2f} 0.8"/>'
        for i in range(OBSTACLES)
    )
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.xml"
        floor = '<geom name="floor" size="0 0 0.05" type="plane"/>'
        scene.write_text(f"<mujoco><worldbody>{floor}{geoms}</worldbody></mujoco>")
        name = f"crazyflow, {OBSTACLES} obstacles, depth"
        rows.append(measure(name, 20, 10, CAMERA_STEP_S, scene))  # 100 worlds are slower
    return rows


def measure_pyflyt() -> list[Result]:
    from PyFlyt.core import Aviary

    rng = np.random.default_rng(0)

    def measure(name: str, camera: bool) -> Result:
        step_s = CAMERA_STEP_S if camera else STEP_S
        options = {"use_camera": True, "camera_resolution": (HEIGHT, WIDTH), "camera_fps": 10}
        with contextlib.redirect_stdout(io.StringIO()):
            aviary = Aviary(
                start_pos=np.array([[0.0, 0.0, 2.5]]),
                start_orn=np.zeros((1, 3)),
                drone_type="quadx",
                drone_options=options if camera else {},
                seed=1,
            )
        if camera:
            for i in range(OBSTACLES):
                half = [0.8, 0.8, 0.8]
                shape = aviary.createVisualShape(aviary.GEOM_BOX, halfExtents=half)
                hull = aviary.createCollisionShape(aviary.GEOM_BOX, halfExtents=half)
                where = [*rng.uniform(2, 20, 2), 0.8 * (1 + i % 2)]
                aviary.createMultiBody(0, hull, shape, where)
            aviary.register_all_new_bodies()
        aviary.set_mode(6)  # vx, vy, yaw rate, vz
        loop_s = aviary.step_period

        def stretch() -> tuple[float, float]:
            loops = round((3.0 if camera else 2.0) / loop_s)
            every = step_s / loop_s
            start, due = time.process_time(), 0.0
            for loop in range(loops):
                if loop >= due:
                    due += every
                    aviary.set_setpoint(0, rng.uniform([-1, -1, -1, -0.2], [1, 1, 1, 0.2]))
                aviary.step()
            return loops / every, time.process_time() - start

        row = result(name, step_s, aviary.physics_hz, *fastest(stretch))
        aviary.disconnect()
        return row

    return [
        measure("PyFlyt QuadX, nothing but the vehicle", False),
        measure(f"PyFlyt QuadX, {OBSTACLES} boxes, colour and depth", True),
    ]


def measure_gpd() -> list[Result]:
    import pybullet
    from gym_pybullet_drones.envs.VelocityAviary import VelocityAviary

    rng = np.random.default_rng(0)

    def measure(name: str, camera: bool, ctrl_hz: int, steps: int) -> Result:
        with contextlib.redirect_stdout(io.StringIO()):
            env = VelocityAviary(
                gui=False,
                pyb_freq=240,
                ctrl_freq=ctrl_hz,
                user_debug_gui=False,
                initial_xyzs=np.array([[0.0, 0.0, 2.5]]),
            )
            env.reset(seed=0)
        if camera:
            env.IMG_RES = np.array([WIDTH, HEIGHT])
            client = env.getPyBulletClient()
            for _ in range(OBSTACLES):
                shape = pybullet.createVisualShape(
                    pybullet.GEOM_BOX, halfExtents=[0.8] * 3, physicsClientId=client
                )
                where = [*rng.uniform(2, 20, 2), 0.8]
                pybullet.createMultiBody(0, -1, shape, where, physicsClientId=client)

        def stretch() -> tuple[float, float]:
            start = time.process_time()
            for _ in range(steps):
                env.step(np.append(rng.uniform(-1, 1, 3), 0.5)[None])
                if camera:
                    env._getDroneImages(0, segmentation=False)
            return steps, time.process_time() - start

        row = result(name, 1.0 / ctrl_hz, 240.0, *fastest(stretch))
        env.close()
        return row

    return [
        measure("gym-pybullet-drones, nothing but the vehicle", False, 48, 200),
        measure(f"gym-pybullet-drones, {OBSTACLES} boxes, colour and depth", True, 10, 40),
    ]


MEASURES: dict[str, Callable[[], list[Result]]] = {
    "ours": measure_ours,
    "crazyflow": measure_crazyflow,
    "pyflyt": measure_pyflyt,
    "gpd": measure_gpd,
}


def in_a_process(name: str, python: str) -> list[Result] | str:
    """Return what an interpreter measures, or why it does not."""
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    environment = {**os.environ, **one_thread, "JAX_PLATFORMS": "cpu", "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(  # noqa: S603 - the interpreter is the user's choice
        [python, __file__, "--measure", name],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    lines = done.stdout.splitlines()
    if done.returncode or not lines:
        return (done.stderr.strip().splitlines() or ["no output"])[-1]
    rows: list[Result] = json.loads(lines[-1])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for option in ("--crazyflow-python", "--pyflyt-python", "--gpd"):
        parser.add_argument(option, metavar="PATH", help="interpreter of an environment with it")
    parser.add_argument("--measure", choices=MEASURES, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        print(json.dumps(MEASURES[arguments.measure]()))
        return

    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"Environment steps a second, one core (best of {STRETCHES})")
    table.add_column("simulator", no_wrap=True)
    for heading in ("step [ms]", "physics [Hz]", "steps/s", "ticks/s", "flight s/s"):
        table.add_column(heading, justify="right")
    interpreters = {
        "ours": sys.executable,
        "crazyflow": arguments.crazyflow_python,
        "pyflyt": arguments.pyflyt_python,
        "gpd": arguments.gpd,
    }
    for name, python in interpreters.items():
        if python is None:
            table.add_row(name, *["not given"] + [""] * 4)
            continue
        rows = in_a_process(name, python)
        if isinstance(rows, str):
            table.add_row(name, f"failed: {rows}")
            continue
        for row in rows:
            table.add_row(
                row["name"],
                f"{1000 * row['step_s']:.0f}",
                f"{row['hz']:.0f}",
                f"{row['steps']:,.0f}",
                f"{row['ticks']:,.0f}",
                f"{row['steps'] * row['step_s']:,.1f}",
            )
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
