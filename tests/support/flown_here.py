"""Flights in lockstep in this process, where who flies them is not under test."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from unittest.mock import patch

from airl_mav.experiments import experiment
from airl_mav.experiments.executors import Executor, open_executor
from airl_mav.scenario.model import Workers


@contextmanager
def flown_here() -> Iterator[None]:
    """Let one worker be this process, at level lockstep as at level gym.

    The process that it is otherwise takes longer to start than a flight; that the flights are the
    same is the subject of test_evaluate_lockstep.py.
    """

    def here(settings: Workers, *, in_process: bool = False) -> AbstractContextManager[Executor]:
        return open_executor(settings, in_process=in_process or settings.workers == 1)

    with ExitStack() as stack:
        for module in (experiment, experiment):
            stack.enter_context(patch.object(module, "open_executor", here))
        yield
