"""Arguments of a decision for n vehicles in one object, for a single compiled call.

Numba unpacks every array of every argument at each call, which takes longer than a vehicle's
decision. A `World` is unpacked once.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numba.experimental import structref
from numpy.typing import NDArray

from airl_mav.core.constants import TICK_US, US_PER_S
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.envs.arena_batch import ArenaBatch
from airl_mav.envs.cameras import Eye, render_images
from airl_mav.envs.decision import DecisionBatch, plan
from airl_mav.envs.draws import BLOCK, Drift, step_error
from airl_mav.envs.fleet import Fleet, FleetConstants, FlightStatus, Rules
from airl_mav.envs.fleet_step import fly
from airl_mav.envs.observations import EncodedBody, encode_body
from airl_mav.envs.rewards import pay
from airl_mav.policy.images import Bytes

GOES_ON, TERMINATED, TRUNCATED = 0, 1, 2
"""End of flight in a decision; GOES_ON also for flights that had ended before."""

_FLYING, _TIMEOUT = int(FlightStatus.FLYING), int(FlightStatus.TIMEOUT)


@structref.register
class _WorldType(types.StructRef):  # type: ignore[misc]
    """Numba type of a `World`; depends on the types of the parts."""


class World(structref.StructRefProxy):  # type: ignore[misc]
    """Arguments of a decision of n vehicles; arrays are shared with its parts, not copied."""

    fleet: Fleet
    arenas: ArenaBatch
    vehicle: FleetConstants
    rules: Rules
    decision: DecisionBatch
    t2_us: NDArray[np.int64]
    """(n, BLOCK) `DelayDraws.block`."""
    extra_us: NDArray[np.int64]
    """(n,) additional delay, added to `t2_us` [µs]."""
    number: NDArray[np.int64]
    """(n,) number of the present decision in each episode."""
    air: NDArray[np.float64]
    drift: Drift | None
    eye: Eye | None
    """Camera for kernels; None = Python captures the images."""
    encoding: Bytes | None
    """Constants for encoding; None = Python encodes observations."""
    reward: int
    """Index of the reward, as in `rewards.pay`."""
    hold_s: float

    def __new__(cls, *parts: Any) -> World:  # noqa: D102
        made: World = _made(*parts)
        return made


structref.define_boxing(_WorldType, World)
structref.define_constructor(World, _WorldType, list(World.__annotations__))


@kernel
def _made(*parts: Any) -> Any:
    return World(*parts)


@kernel
def decide(
    world: World,
    commands: NDArray[np.float64],
    resumed: bool,
    numbers: NDArray[np.float64],
    whole: NDArray[np.int64],
    seen: EncodedBody,
) -> int:
    """Fly one decision of every vehicle, capture the frames of the next one, and encode them.

    Args:
        world: The vehicles.
        commands: (n, 3) or (n, 4) as in `Navigation.fly`.
        resumed: True to continue decisions after a pause for Python.
        numbers: (7, n) written: the float fields of `FlightArrays` in order, and the rewards.
        whole: (3, n) written: verdict, touched object, and end of flight in the decision.
        seen: Encoded observations; written unless empty.

    Returns:
        Number of decisions that wait for Python; frames are captured once it is 0.
    """
    # Read fields once: each access counts references of all arrays. The loops do not.
    w, decision, fleet, goal = world, world.decision, world.fleet, world.arenas.goal
    if not resumed:
        _begin(decision, fleet, goal, commands, w.t2_us, w.number, w.extra_us)
        plan(decision, fleet)
    # After a pause only unfinished decisions continue.
    todo = (decision.next < decision.events).astype(np.int64)
    going = todo.copy()
    fly(fleet, w.arenas, todo, w.vehicle, w.rules, w.air, decision)
    waiting = _end(decision, fleet, w.drift, w.number, going)
    if waiting == 0:
        render_images(decision.seen, w.arenas, np.ones(len(todo), np.bool_), w.eye)
        # Status and rewards follow the last event of all vehicles.
        status(fleet, goal, numbers, whole)
        _judge(decision, commands, numbers, whole, w.reward, w.hold_s)
        if len(seen.depth) > 0:
            _encode(world, world.eye, world.encoding, seen)
    return waiting


@borrowing_kernel
def _begin(
    decision: DecisionBatch,
    fleet: Fleet,
    goal: NDArray[np.float64],
    commands: NDArray[np.float64],
    t2_us: NDArray[np.int64],
    number: NDArray[np.int64],
    extra_us: NDArray[np.int64],
) -> None:
    """Set commands as setpoints, and draws as latencies; arguments as in `World` and `decide`."""
    for i in range(len(commands)):
        decision.t2_us[i] = t2_us[i, number[i] % BLOCK] + extra_us[i]
        decision.before_m[i] = goal_distance(fleet, goal, i)
        # Body rates and thrust pass unchanged.
        setpoint, command = decision.setpoint[i], commands[i]
        if decision.timing.timeout >= 0:
            for axis in range(4):
                setpoint[axis] = command[axis]
            continue
        setpoint[0], setpoint[1], setpoint[3] = command[0], command[1], command[2]
        # NaN = altitude hold, computed when the setpoint is sent.
        setpoint[2] = command[3] if len(command) == 4 else math.nan


@borrowing_kernel
def _end(
    decision: DecisionBatch,
    fleet: Fleet,
    drift: Drift | None,
    number: NDArray[np.int64],
    going: NDArray[np.int64],
) -> int:
    """Count completed decisions among `going`; return the number of unfinished ones."""
    waiting = 0
    for i in range(len(going)):
        if decision.next[i] < decision.events[i]:
            waiting += 1
        elif going[i] > 0:
            number[i] += 1
            ticks = (fleet.time_us[i] - decision.began_us[i]) // TICK_US
            if drift is not None:
                step_error(drift, decision.errors, i, number[i], ticks)
    return waiting


@kernel
def _encode(world: World, eye: Eye | None, encoding: Bytes | None, seen: EncodedBody) -> None:
    if eye is not None and encoding is not None:
        errors, goal = world.decision.errors, world.arenas.goal
        encode_body(world.fleet, errors, eye.image, goal, encoding, seen)


@borrowing_kernel
def _judge(
    decision: DecisionBatch,
    commands: NDArray[np.float64],
    numbers: NDArray[np.float64],
    whole: NDArray[np.int64],
    reward: int,
    hold_s: float,
) -> None:
    """Write rewards and ends of flights; arguments as in `World` and `decide`."""
    for i in range(len(commands)):
        verdict, command = whole[0, i], commands[i]
        # Only the decision in which a flight ends counts.
        ended = decision.flying[i] and verdict != _FLYING
        whole[2, i] = (TRUNCATED if verdict == _TIMEOUT else TERMINATED) if ended else GOES_ON
        # The yaw rate is the third command, of velocities and of body rates.
        turned = command[2] * command[2]
        if decision.timing.timeout >= 0:
            turned = command[0] * command[0] + command[1] * command[1] + turned
        passed_s = numbers[0, i] - decision.began_us[i] / US_PER_S
        before_m, now_m, speed_m_s = decision.before_m[i], numbers[3, i], numbers[4, i]
        numbers[6, i] = pay(reward, verdict, before_m, now_m, passed_s, speed_m_s, turned, hold_s)


@borrowing_kernel
def goal_distance(fleet: Fleet, goal: NDArray[np.float64], i: int) -> float:
    """Return the distance of vehicle i to its goal [m]; horizontal if the goal has no height."""
    p = fleet.position[i]
    away, below = math.hypot(goal[i, 0] - p[0], goal[i, 1] - p[1]), goal[i, 2] - p[2]
    return away if math.isnan(below) else math.hypot(away, below)


@borrowing_kernel
def status(
    fleet: Fleet, goal: NDArray[np.float64], numbers: NDArray[np.float64], whole: NDArray[np.int64]
) -> None:
    """Write the status of all flights; see `decide`."""
    for i in range(len(goal)):
        v = fleet.velocity[i]
        numbers[0, i] = fleet.time_us[i] / US_PER_S
        numbers[1, i], numbers[2, i] = fleet.distance[i], fleet.energy[i]
        numbers[3, i] = goal_distance(fleet, goal, i)
        numbers[4, i] = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        numbers[5, i] = fleet.battery[i]
        whole[0, i], whole[1, i] = fleet.verdict[i], fleet.touched[i]
