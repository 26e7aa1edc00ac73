"""The command line of `airl-companion`, and what is made of it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from airl_mav.cli import companion_lockstep
from airl_mav.cli.common import (
    GREATEST_PORT,
    GREATEST_SEED,
    check_range,
)
from airl_mav.core.clock import Clock
from airl_mav.core.cpu_quota import check_permitted
from airl_mav.core.errors import UsageError
from airl_mav.latency.injection import Injection
from airl_mav.latency.samplers import LatencySampler, latency_generator
from airl_mav.latency.source import select_injection
from airl_mav.policy.actions import Policy
from airl_mav.policy.registry import DEFAULT_POLICY, PolicyInfo, find_policy, load_policy
from airl_mav.policy.runtime import RuntimeName
from companion.camera import ZmqFrameSource
from companion.mavsdk_link import MavsdkLink
from companion.pilot import PilotSettings
from companion.watchdog import WatchdogSettings

GREATEST_THREADS = 64

CHANCE_STREAM = 1
"""Second word of the seed of a policy's random actions: not the numbers that draw the latency."""


@dataclass(frozen=True)
class PilotOptions:
    """How the policy is flown; what is left out is as the policy's card says."""

    hold_s: float | None = None
    """t3: how long an action is held before the next observation, s. None: that of the policy's
    card, or 0.5."""

    goal_radius_m: float | None = None
    """The goal is reached closer than this, seen from above, m. None: that of the policy's card,
    or 2."""

    altitude_m: float | None = None
    """Height above the start that is held, m. None: that of the policy's card, or 2.5."""

    max_speed_m_s: float | None = None
    """Horizontal speed limit of all actions, m/s. None: the fastest action of the policy's card,
    or 5."""


@dataclass(frozen=True)
class CompanionCommand:
    """Fly a policy from take-off to a goal, through MAVSDK."""

    goal: tuple[float, float] = (20.0, 0.0)
    """Goal, north and east of the start, m."""

    policy: str = DEFAULT_POLICY
    """Policy that decides: a name, or a path to a folder with policy.onnx and card.json."""

    runtime: RuntimeName = "onnx"
    """What runs a learned policy; torch needs its policy.pt2."""

    threads: int = 1
    """Threads of one inference."""

    cpu_quota: float | None = None
    """Hold this program to so many percent of one core, for real, by a Linux control group; 1 to
    6400. None: no limit."""

    connect: str = "udpin://127.0.0.1:14540"
    """MAVSDK connection to the flight controller: udpin://HOST:PORT or serial://DEVICE:BAUD."""

    camera: str = "tcp://127.0.0.1:5600"
    """ZeroMQ address of the depth camera."""

    computer: str = "workstation"
    """Computer profile to fly as: a shipped name, or a path to a .toml."""

    workload: str | None = None
    """Workload of the computer profile whose latency t2 is injected; estimate: scaled to this
    policy. None: nothing is injected."""

    latency: str | None = None
    """Latency t2 to inject, in place of --workload: 150ms, lognormal:396ms,20ms (mean, standard
    deviation), normal:396ms,20ms, COMPUTER/WORKLOAD, or a file of measured latencies, one a line in
    ms, which are replayed in their order. None: as --computer and --workload say."""

    latency_seed: int = 0
    """Other draws of the same latency in the same flight; 0: those of its own seed."""

    lockstep: bool = False
    """Take turns with a simulator that waits for this program (airl-firmware --lockstep):
    simulated time moves only while it sleeps, and every flight of a seed is the same."""

    speed: float = 1.0
    """Simulated seconds per wall second of the simulator, > 0; 1 on a real aircraft."""

    seed: int = 1
    """Seed of the injected latency, and of random actions if the policy's card has any."""

    connect_timeout: float = 30.0
    """How long to wait for the flight controller, s; with --lockstep for each of its turns, too."""

    pilot: tyro.conf.OmitArgPrefixes[PilotOptions] = field(default_factory=PilotOptions)
    """How the policy is flown."""

    watchdog: tyro.conf.OmitArgPrefixes[WatchdogSettings] = field(default_factory=WatchdogSettings)
    """Bounds on silence."""

    log: Path | None = None
    """Write the stamps of every decision to this .npz file. None: no file."""

    control: Literal["stdio"] | None = None
    """stdio: take requests from a harness, JSON lines on standard input. None: stand alone."""


def check(command: CompanionCommand) -> PilotSettings:
    """Check everything that can be wrong before a connection is opened.

    Returns:
        How the policy will be flown.

    Raises:
        UsageError: Names the option, its value and what is accepted.
    """
    check_range("--speed", command.speed, 0.1, 100.0)
    check_range("--seed", command.seed, 0, GREATEST_SEED)
    check_range("--latency-seed", command.latency_seed, 0, GREATEST_SEED)
    check_range("--connect-timeout", command.connect_timeout, 0.1, 3600.0)
    for metres in command.goal:
        check_range("--goal", metres, -10_000.0, 10_000.0)
    check_range("--threads", command.threads, 1, GREATEST_THREADS)
    check_quota(
        command.cpu_quota,
        lockstep=command.lockstep,
        injected=injection(command).latency is not None,
    )
    pilot = pilot_settings(command.pilot, find_policy(command.policy))
    check_range("--goal-radius-m", pilot.goal_radius_m, 0.1, 50.0)
    check_range("--altitude-m", pilot.altitude_m, 0.5, 100.0)
    check_range("--max-speed-m-s", pilot.max_speed_m_s, 0.1, 30.0)
    check_holding("--hold-s", pilot.hold_s, command.watchdog)
    if command.log is not None and not command.log.parent.is_dir():
        raise UsageError(f"--log {command.log}: no folder {command.log.parent}")
    sampler(command, command.seed)
    return pilot


def check_quota(percent: float | None, *, lockstep: bool, injected: bool) -> None:
    """Check a limit on the processor. Raises UsageError when it is not permitted, or no use."""
    if percent is None:
        return
    if lockstep or injected:
        option = "--lockstep" if lockstep else "an injected latency"
        raise UsageError(
            f"--cpu-quota {percent:g} with {option}: accepted: without, where this program's own "
            "time counts"
        )
    check_permitted(percent)


def pilot_settings(options: PilotOptions, policy: PolicyInfo) -> PilotSettings:
    """Return how a policy is flown: as asked, else as its card says, else by default."""
    card = policy.card
    known = {}
    if card is not None:
        known = {
            "hold_s": card.hold_s,
            "goal_radius_m": card.goal_radius_m,
            "altitude_m": card.altitude_m,
            "max_speed_m_s": card.actions.max_speed_m_s,
        }
    asked = {name: value for name, value in asdict(options).items() if value is not None}
    return PilotSettings(**(known | asked))


def watchdog_settings(command: CompanionCommand) -> WatchdogSettings:
    """Return the bounds on silence: as asked, with what the policy's card says of hovering."""
    hover_s = hover_after_s(command.watchdog, find_policy(command.policy))
    return replace(command.watchdog, hover_after_s=hover_s)


def hover_after_s(asked: WatchdogSettings, policy: PolicyInfo) -> float | None:
    """Return when an action that nothing has followed is stopped: as asked, else as on the card."""
    if asked.hover_after_s is not None or policy.card is None:
        return asked.hover_after_s
    return policy.card.hover_after_s


def check_holding(option: str, hold_s: float, watchdog: WatchdogSettings) -> None:
    """Check the hold time and the watchdog's bounds against each other. Raises UsageError."""
    check_range(option, hold_s, 0.0, 10.0)
    check_range("--decision-timeout-s", watchdog.decision_timeout_s, 0.1, 60.0)
    check_range("--leave-after-s", watchdog.leave_after_s, 0.1, 60.0)
    if watchdog.hover_after_s is not None:
        check_range("--hover-after-s", watchdog.hover_after_s, 0.0, 60.0)
    if watchdog.decision_timeout_s <= hold_s:
        raise UsageError(
            f"--decision-timeout-s {watchdog.decision_timeout_s:g}: accepted: more than "
            f"{option} {hold_s:g}, or every decision is overdue"
        )


@contextmanager
def opened(
    command: CompanionCommand, clock: Clock, abandon: threading.Event
) -> Iterator[tuple[MavsdkLink, ZmqFrameSource]]:
    """Open link and camera for a while. Raises UsageError for an address that is none."""
    with (
        closing(open_camera(command.camera, clock)) as frames,
        closing(MavsdkLink(command.connect, clock, abandon)) as link,
    ):
        yield link, frames


def open_camera(endpoint: str, clock: Clock) -> ZmqFrameSource:
    """Connect to the camera. Raises UsageError for an address that is none."""
    port = endpoint.rpartition(":")[2]
    # libzmq would cut the number to 16 bits without a word.
    if endpoint.startswith("tcp:") and not (port.isdecimal() and 1 <= int(port) <= GREATEST_PORT):
        raise UsageError(f"--camera {endpoint}: accepted: tcp://HOST:PORT, port 1..{GREATEST_PORT}")
    try:
        return ZmqFrameSource(endpoint, clock)
    except ValueError as error:
        raise UsageError(f"--camera: {error}") from None


def sampler(command: CompanionCommand, seed: int) -> LatencySampler | None:
    """Return where t2 is drawn from. Raises UsageError for an unknown computer or workload."""
    return injection(command).sampler(latency_generator(seed, command.latency_seed))


def injection(command: CompanionCommand) -> Injection:
    """Return the latency to fly with. Raises UsageError for an unknown computer or workload."""
    policy = find_policy(command.policy)
    return select_injection(
        command.latency,
        command.computer,
        command.workload,
        # Alone it runs on the computer that it flies on: what was measured there is no addition.
        # In lockstep no computer's own time counts.
        policy_sha256=policy.sha256 if command.control or command.lockstep else None,
        macs=policy.macs,
    )


def load(command: CompanionCommand, pilot: PilotSettings) -> Policy:
    """Return the policy, ready to decide. Raises UsageError when it cannot be run as asked."""
    return load_policy(
        command.policy,
        pilot.hold_s,
        runtime=command.runtime,
        threads=command.threads,
        rng=chance(command.seed),
    )


def chance(seed: int) -> np.random.Generator:
    """Return the source of a policy's random actions in the flight of a seed."""
    return np.random.default_rng((seed, CHANCE_STREAM))


def lockstep_mission(
    command: CompanionCommand,
    pilot: PilotSettings,
    policy: Policy,
    goal: tuple[float, float],
    seed: int,
) -> companion_lockstep.Mission:
    """Return what is flown in lockstep. Raises UsageError as `sampler`."""
    return companion_lockstep.Mission(
        goal, policy, pilot, watchdog_settings(command), sampler(command, seed)
    )
