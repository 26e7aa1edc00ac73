"""`airl profile --level bare`: the network alone, on the machine that runs this."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.cli.profile_plan import Measured, ProfilePlan
from airl_mav.core.clock import Clock, WallClock, processor_time_us
from airl_mav.policy.actions import Policy, limited
from airl_mav.policy.layouts import camera_mismatch
from airl_mav.policy.learned import LearnedPolicy, open_network
from airl_mav.policy.observation import Kinematics, encode

SEEN = 64
"""Different observations, one after the other: caches must not know them by heart."""

GOAL = 20.0, 5.0
"""North, east [m]."""

OBSERVATION_STREAM, CHANCE_STREAM = 11, 12
"""Second words of the seed."""


def measure(plan: ProfilePlan, progress: Callable[[int], None]) -> Measured:
    """Time the decisions.

    Args:
        plan: What is measured.
        progress: Called with the number of decisions so far, warm-up included.
    """
    command, clock = plan.command, WallClock()
    policy, load_us = opened(plan, clock)
    views = seen_by(plan)
    starts, ends = [], []
    used_us = processor_time_us()
    for k in range(command.warm_up + command.decisions + 1):
        view = views[k % SEEN]
        start_us = clock.time_us()
        decide(plan, policy, view)
        ends.append(clock.time_us())
        starts.append(start_us)
        progress(k)
    used_us = processor_time_us() - used_us
    share = used_us / max(ends[-1] - starts[0], 1)
    first = 1 + command.warm_up
    stamps = {
        "infer_start_us": np.array(starts[first:], np.int64),
        "action_ready_us": np.array(ends[first:], np.int64),
    }
    return Measured(
        flights=(stamps,),
        seen=None,
        load_us=load_us,
        first_us=ends[0] - starts[0],
        remarks=(
            "inference alone, one decision straight after the other: no camera and no telemetry "
            "ran beside it, which may slow it down (--level sitl, --level hil)",
            f"this process used {share:.2g} cores of processor time with {command.threads} "
            f"thread{'s' if command.threads > 1 else ''}: less than one means that it had to wait",
        ),
    )


def decide(plan: ProfilePlan, policy: Policy, view: tuple[Frame, Kinematics]) -> None:
    """Do what the pilot does between its stamps of t2."""
    limited(policy.act(encode(*view, GOAL)), plan.card.actions.max_speed_m_s)


def opened(plan: ProfilePlan, clock: Clock) -> tuple[Policy, int]:
    """Return the policy before its first inference, and how long that took [µs]."""
    command = plan.command
    start_us = clock.time_us()
    network = open_network(plan.folder, plan.card, command.runtime, command.threads)
    load_us = clock.time_us() - start_us
    rng = np.random.default_rng((command.seed, CHANCE_STREAM))
    return LearnedPolicy(plan.card, network, rng=rng), load_us


def typical_us(plan: ProfilePlan, count: int = 20) -> tuple[int, int, int]:
    """Return opening, first and median later decision [µs], from a few of them."""
    clock = WallClock()
    policy, load_us = opened(plan, clock)
    views, times = seen_by(plan), []
    for k in range(count):
        start_us = clock.time_us()
        decide(plan, policy, views[k % SEEN])
        times.append(clock.time_us() - start_us)
    return load_us, times[0], round(float(np.median(times[1:])))


def seen_by(plan: ProfilePlan) -> list[tuple[Frame, Kinematics]]:
    """Return what is seen: noise of the camera's size, and a vehicle on its way."""
    spec = plan.card.observation
    lens = plan.camera
    if camera_mismatch(spec, lens) is not None:
        fov = math.radians(spec.horizontal_fov_deg)
        lens = Intrinsics.from_fov(spec.width_px, spec.camera_rows, fov)
    rng = np.random.default_rng((plan.command.seed, OBSERVATION_STREAM))
    level = np.array([1.0, 0.0, 0.0, 0.0])
    return [
        (
            Frame(k, 0, rng.integers(0, 20_000, (lens.height, lens.width), np.uint16), lens),
            Kinematics(rng.normal(0.0, 5.0, 3), rng.normal(0.0, 2.0, 3), level),
        )
        for k in range(SEEN)
    ]
