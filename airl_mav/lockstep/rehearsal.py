"""Episodes in lockstep in this process, one after the other, with somebody who looks on."""

from __future__ import annotations

from collections.abc import Collection

from airl_mav.lockstep.flight import Watching, fly
from airl_mav.rehearsal.channel import Text
from airl_mav.rehearsal.rehearsal import Observer
from airl_mav.rehearsal.run_folder import RunFolder
from airl_mav.rehearsal.true_state import state_of
from airl_mav.scenario.resolved import ResolvedScenario
from firmware_sim.autopilot.autopilot_state import Message
from firmware_sim.simulation import Simulation
from firmware_sim.warm_up import warm_up

SHOW_EVERY = 125
"""The observer sees the true state every so many ticks: twice a simulated second."""


def rehearse(
    scenario: ResolvedScenario, folder: RunFolder, observer: Observer, done: Collection[int] = ()
) -> None:
    """Fly episodes; each is saved as it ends.

    Args:
        scenario: What is flown.
        folder: Where everything goes.
        observer: Who looks on.
        done: Numbers of the episodes that need not be flown.

    Raises:
        UsageError: The policy cannot use the camera; no arena can be made of a seed.
        LockstepError: The companion hangs, or broke.
    """
    observer.waiting("loading")
    warm_up(scenario.vehicle)
    for index, seed in enumerate(scenario.scenario.seeds):
        if index in done:
            continue
        flown = fly(
            scenario,
            scenario.fresh_policy(seed),
            index,
            seed,
            tlog=folder.tlog_path(index),
            watching=_watching(observer, index, seed),
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
