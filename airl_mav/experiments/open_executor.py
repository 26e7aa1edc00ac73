"""Which executor is asked for: this process, worker processes, or Ray."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from airl_mav.core.errors import FieldError
from airl_mav.core.provenance import usable_cores
from airl_mav.experiments.executors import Executor, ExecutorSettings, InProcessExecutor
from airl_mav.experiments.process_executor import ProcessExecutor
from airl_mav.scenario.aircraft import GREATEST_INSTANCE, Aircraft
from airl_mav.scenario.model import GREATEST_WORKERS, Workers


def side_by_side(settings: Workers) -> int:
    """Return how many flights of a scenario may be flown at a time: each of PX4's is an instance.

    The user starts one PX4 after the other, if any.
    """
    if not isinstance(settings, Aircraft) or settings.firmware == "builtin":
        return GREATEST_WORKERS
    real = settings.real
    return 1 if real.px4_dir is None else GREATEST_INSTANCE + 1 - real.instance


@contextmanager
def open_executor(settings: Workers, *, in_process: bool = False) -> Iterator[Executor]:
    """Give the executor that was asked for.

    Args:
        settings: What was asked for; without settings of its own no job takes a GPU.
        in_process: Whether one worker may be this process; one is then the default, too.

    Raises:
        UsageError: Ray is not installed, or not to be reached; too many workers for the firmware.
    """
    cores = min(usable_cores(), GREATEST_WORKERS)
    if settings.executor == "ray":
        # Imported here: Ray is an extra.
        from airl_mav.experiments.ray_executor import connected

        gpus = settings.ray_gpus if isinstance(settings, ExecutorSettings) else 0.0
        with connected(settings, cores, gpus) as executor:
            yield executor
        return
    most = side_by_side(settings)
    if settings.workers is not None and settings.workers > most:
        raise FieldError("workers", settings.workers, f"1 <= value <= {most} with this firmware")
    workers = settings.workers or (1 if in_process else min(cores, most))
    if in_process and workers == 1:
        yield InProcessExecutor()
        return
    with ProcessExecutor(workers) as executor:
        yield executor
