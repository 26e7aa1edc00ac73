"""`airl-companion`, `airl companion`: what runs on the drone's onboard computer."""

from __future__ import annotations

import signal
import threading
from pathlib import Path

from pydantic import Field
from rich.console import Console

from airl_mav.cli.options import run_command
from airl_mav.core.errors import EXIT_BROKEN, EXIT_INTERRUPTED, FieldError
from airl_mav.core.fields import quantity
from airl_mav.core.files import save_arrays
from airl_mav.latency.samplers import latency_generator
from airl_mav.policy.registry import find_policy, load_policy
from airl_mav.scenario.model import DEFAULT_POLICY, GREATEST_SEED, Decisions, Lateness
from airl_mav.scenario.piloting import check_quota, check_trust, decide_piloting, select_latency
from airl_mav.scenario.resolved import action_generator
from companion.conducted import Abandoned
from companion.interfaces import LinkError
from companion.mission import MissionResult
from companion.program import Mission, fly_alone


class CompanionOptions(Lateness, Decisions):
    """Fly a policy from take-off to a goal, through MAVSDK.

    Examples:
        airl-companion --goal 20 5
        airl-companion --connect serial:///dev/ttyAMA0:921600 --camera tcp://192.168.1.10:5600
        airl-companion --lockstep --goal 20 5     (with airl-firmware --lockstep)
    """

    policy: str = Field(
        default=DEFAULT_POLICY,
        description="policy that decides: a name, or a path to a folder with policy.onnx and"
        " card.json",
    )
    goal: tuple[float, float] = Field(
        default=(20.0, 0.0), description="goal, north and east of the start, m, within 10 km"
    )
    connect: str = Field(
        default="udpin://127.0.0.1:14540",
        description="MAVSDK connection to the flight controller: udpin://HOST:PORT or"
        " serial://DEVICE:BAUD",
    )
    camera: str = Field(
        default="tcp://127.0.0.1:5600", description="ZeroMQ address of the depth camera"
    )
    lockstep: bool = Field(
        default=False,
        description="take turns with a simulator that waits for this program (airl-firmware"
        " --lockstep): every flight of a seed is the same",
    )
    speed: float = quantity(
        "simulated seconds per wall second of the simulator; 1 on a real aircraft",
        "1",
        ge=0.1,
        le=100,
        default=1.0,
    )
    seed: int = quantity(
        "seed of the injected latency, and of random actions if the policy's card has any",
        "1",
        ge=0,
        le=GREATEST_SEED,
        default=1,
    )
    connect_timeout: float = quantity(
        "longest wait for the flight controller; in lockstep for each of its turns, too",
        "s",
        ge=0.1,
        le=3600,
        default=30.0,
    )
    log: Path | None = Field(
        default=None, description="write the stamps of every decision to this .npz file"
    )


OPTIONS = CompanionOptions
EXTRAS = ()


def run(options: CompanionOptions, console: Console | None = None) -> int:
    """Fly one mission.

    Returns:
        Exit status: 0 the goal was reached, 1 it was not, 130 Ctrl-C.

    Raises:
        UsageError: The input cannot be used.
    """
    console = console or Console(soft_wrap=True)
    mission = _mission(options)
    stop, abandon, interrupted = threading.Event(), threading.Event(), threading.Event()

    def interrupt(*_: object) -> None:
        interrupted.set()
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    what = "simulator" if options.lockstep else "flight controller"
    console.print(f"waiting for a {what} on {options.connect}", markup=False)
    try:
        result = _fly(options, mission, stop, abandon, console)
    except (LinkError, Abandoned) as error:
        console.print(f"error: {error}", style="red", markup=False)
        return EXIT_INTERRUPTED if interrupted.is_set() else EXIT_BROKEN
    if options.log is not None:
        save_arrays(options.log, result.log.columns())
    for note in result.notes:
        console.print(note, style="yellow", markup=False)
    console.print(f"{result.reason}; {len(result.log)} decisions")
    if result.reason == "goal reached":
        return 0
    return EXIT_INTERRUPTED if interrupted.is_set() else EXIT_BROKEN


def _mission(options: CompanionOptions) -> Mission:
    """Check all that can be wrong before a connection is opened, and load the policy."""
    for metres in options.goal:
        if not abs(metres) <= 10_000.0:
            raise FieldError("goal", metres, "-10000 <= value <= 10000 m")
    if options.log is not None and not options.log.parent.is_dir():
        raise FieldError("log", options.log, problem=f"no folder {options.log.parent}")
    policy = find_policy(options.policy)
    check_trust(options, policy)
    pilot, watchdog = decide_piloting(options, policy, goal_radius_m=2.0)
    # In lockstep no computer's own time counts; alone, this is the computer that is flown as.
    injection = select_latency(options, policy, on_this_computer=not options.lockstep)
    check_quota(options, injection, "lockstep" if options.lockstep else "sitl")
    loaded = load_policy(
        policy,
        pilot.hold_s,
        runtime=options.runtime,
        threads=options.threads,
        rng=action_generator(options.seed),
        ablate=options.ablate,
    )
    sampler = injection.sampler(latency_generator(options.seed, options.latency_seed))
    return Mission(options.goal, loaded, pilot, watchdog, sampler)


def _fly(
    options: CompanionOptions,
    mission: Mission,
    stop: threading.Event,
    abandon: threading.Event,
    console: Console,
) -> MissionResult:
    def progress(phase: str, time_us: int) -> None:
        console.print(f"{time_us / 1e6:8.2f} s  {phase}")

    if not options.lockstep:
        return fly_alone(
            mission,
            connect=options.connect,
            camera=options.camera,
            connect_timeout_s=options.connect_timeout,
            speed=options.speed,
            cpu_quota=options.cpu_quota,
            stop=stop,
            abandon=abandon,
            progress=progress,
        )
    from airl_mav.lockstep.token_companion import fly

    result, sha256 = fly(
        mission,
        options.connect,
        options.camera,
        options.connect_timeout,
        stop,
        abandon,
        progress,
    )
    for name, digest in sha256.items():
        console.print(f"{name:<13} {digest}", highlight=False)
    return result


if __name__ == "__main__":
    run_command("airl-companion", "airl_mav.cli.companion")
