"""A rehearsal in lockstep: N seeded episodes in this process, one run folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from airl_mav.lockstep.flight import LockstepPlan, Watching, fly
from airl_mav.policy.actions import Policy
from airl_mav.rehearsal.channel import Text
from airl_mav.rehearsal.evaluation import Job
from airl_mav.rehearsal.rehearsal import Observer
from airl_mav.rehearsal.run_folder import RunFolder
from airl_mav.rehearsal.state import state_of
from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.simulation import Simulation

SHOW_EVERY = 125
"""The observer sees the true state every so many ticks: twice a simulated second."""


def rehearse(
    plan: LockstepPlan,
    jobs: Sequence[Job],
    fresh_policy: Callable[[int], Policy],
    folder: RunFolder,
    observer: Observer,
) -> None:
    """Fly episodes; each is saved as it ends.

    Args:
        plan: What is flown on what.
        jobs: The episodes.
        fresh_policy: Gives the policy as it begins a flight with a seed.
        folder: Where everything goes.
        observer: Who looks on.

    Raises:
        UsageError: The policy cannot use the camera; no arena can be made of a seed.
        LockstepError: The companion hangs, or broke.
    """
    for job in jobs:
        flown = fly(
            plan,
            fresh_policy(job.seed),
            job.index,
            job.seed,
            tlog=folder.tlog_path(job.index),
            watching=_watching(observer, job.index, job.seed),
        )
        folder.save_episodes([flown])
        observer.finished(flown.record)


def _watching(observer: Observer, index: int, seed: int) -> Watching:
    def text(message: Message, time_us: int) -> None:
        observer.text(Text(time_us=time_us, severity=int(message.severity), text=message.text))

    ticks = 0

    def tick(simulation: Simulation, hit: str | None) -> None:
        nonlocal ticks
        ticks += 1
        if ticks % SHOW_EVERY == 0:
            observer.state(state_of(simulation, hit), simulation.start_us)

    return Watching(
        begin=lambda goal: observer.episode(index, seed, goal),
        phase=observer.phase,
        text=text,
        tick=tick,
    )
