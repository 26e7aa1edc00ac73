"""What all commands share: errors in one line, exit codes."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from importlib.util import find_spec
from typing import TYPE_CHECKING

from rich.console import Console

from airl_mav.core.errors import UsageError, machine_failure
from airl_mav.core.ports import Ports

if TYPE_CHECKING:  # The companion shares this module, and not the simulator.
    from firmware_sim.plant.wind import WindSettings

EXIT_BROKEN = 1
"""The run could not be finished: a flight lost its processes, or its worker, too often."""

EXIT_USAGE = 2
"""The input cannot be used."""

EXIT_INTERRUPTED = 130
"""Ctrl-C (128 + SIGINT)."""


GREATEST_SEED = 2**31
GREATEST_PORT = 65_535


def check_range(option: str, value: float, low: float, high: float) -> None:
    """Raise UsageError unless low <= value <= high; NaN is outside."""
    if not low <= value <= high:
        raise UsageError(f"{option} {value:.10g}: accepted: {low:g} <= value <= {high:.10g}")


def check_draws(latency_seed: int, arena_seed: int | None) -> None:
    """Raise UsageError for seeds that are none."""
    check_range("--latency-seed", latency_seed, 0, GREATEST_SEED)
    if arena_seed is not None:
        check_range("--arena-seed", arena_seed, 0, GREATEST_SEED)


def check_ports(ports: Ports, *, free: bool) -> None:
    """Check the port numbers.

    Args:
        ports: What was asked for.
        free: Whether the camera's port may be 0, any free one.

    Raises:
        UsageError: A number is no port; libzmq would cut it to 16 bits without a word.
    """
    for option, value, low in (
        ("--api-port", ports.api_port, 1),
        ("--api-local-port", ports.api_local_port, 0),
        ("--gcs-port", ports.gcs_port, 1),
        ("--gcs-local-port", ports.gcs_local_port, 0),
        ("--camera-port", ports.camera_port, 0 if free else 1),
    ):
        check_range(option, value, low, GREATEST_PORT)
    if ports.api_port == ports.gcs_port:
        raise UsageError(
            f"--gcs-port {ports.gcs_port}: accepted: another than --api-port {ports.api_port}"
        )


def check_wind(wind: WindSettings) -> None:
    """Raise UsageError for wind that is none."""
    check_range("--wind.north-m-s", wind.north_m_s, -50.0, 50.0)
    check_range("--wind.east-m-s", wind.east_m_s, -50.0, 50.0)
    check_range("--wind.gust-m-s", wind.gust_m_s, 0.0, 50.0)
    check_range("--wind.gust-time-s", wind.gust_time_s, 0.01, 1000.0)


EXTRAS = {
    "profile": ("onnx",),
    "sim": ("filterpy", "jinja2", "matplotlib", "numba", "pybullet", "pymavlink", "scipy"),
    "train": ("gymnasium", "onnx", "onnxscript", "stable_baselines3", "tensorboard", "torch"),
}
"""What the extras install, by their names in pyproject.toml."""


def check_installed(*extras: str) -> None:
    """Raise UsageError, with what to install, unless all that these extras install is there."""
    lacking = {
        extra: missing
        for extra in extras
        if (missing := [name for name in EXTRAS[extra] if find_spec(name) is None])
    }
    if lacking:
        names = ", ".join(sorted({name for missing in lacking.values() for name in missing}))
        raise UsageError(f"not installed: {names}; pip install 'airl-mav[{','.join(lacking)}]'")


def check_train_installed() -> None:
    """Raise UsageError unless all that training needs is installed."""
    check_installed("train")


def _thread_failed(failed: threading.ExceptHookArgs) -> None:
    """Print what ended a thread, unless it was the machine.

    TensorBoard's thread on a full disk: whoever writes next raises the same error again.
    """
    error = failed.exc_value
    if not isinstance(error, OSError) or machine_failure(error) is None:
        threading.__excepthook__(failed)


def run_command(command: Callable[[], int]) -> None:
    """Run a command and exit with its code.

    Usage errors become one line and exit code 2, failures of the machine one line and exit code 1.
    """
    threading.excepthook = _thread_failed
    try:
        code = command()
    except UsageError as error:
        Console(stderr=True, soft_wrap=True).print(f"error: {error}", style="red", markup=False)
        code = EXIT_USAGE
    except OSError as error:
        if (failure := machine_failure(error)) is None:
            raise
        Console(stderr=True, soft_wrap=True).print(f"error: {failure}", style="red", markup=False)
        code = EXIT_BROKEN
    except KeyboardInterrupt:
        code = EXIT_INTERRUPTED
    sys.exit(code)
