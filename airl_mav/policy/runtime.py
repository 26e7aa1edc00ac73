"""Inference runtimes: ONNX Runtime, or torch if installed.

Both are imported only when a network is opened: a classical policy needs neither.

A network with memory takes its memory as additional inputs, and returns the next memory as
additional outputs, whose names begin with `next_`. The runtime is stateless: one runtime serves any
number of flights.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from airl_mav.policy.actions import ActionSpec, continuous_numbers, discrete_actions
from airl_mav.policy.layouts import boxes
from airl_mav.policy.observation_spec import ObservationSpec

RuntimeName = Literal["onnx", "torch"]

ACTION = "action"
"""Name of the action output, the only output of a network without memory."""

NEXT = "next_"
"""Prefix of a memory's output; the rest is the name of its input."""

Shapes = Mapping[str, tuple[int, ...]]
"""Memory of a network: the shape of each array by name, without the leading axis."""

Memory = dict[str, NDArray[np.float32]]
"""Memory of n flights: arrays of n rows by name."""

_ERRORS_ONLY = 3
"""ONNX Runtime's log severity "error": hides warnings about the machine."""

_ONNX_TYPES: dict[type[np.generic], str] = {
    np.uint8: "tensor(uint8)",
    np.float32: "tensor(float)",
}


class Runtime(Protocol):
    """A network ready for inference."""

    def infer(self, encoded: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return the outputs (n, k) for the arrays of a layout, each with n rows."""


@runtime_checkable
class RecurrentRuntime(Runtime, Protocol):
    """A runtime that also supports networks with memory."""

    def step(
        self, encoded: Mapping[str, NDArray[Any]], memory: Memory
    ) -> tuple[NDArray[np.float32], Memory]:
        """Return the outputs (n, k) of a network with memory, and its next memory."""


def blank_memory(shapes: Shapes, n: int) -> Memory:
    """Return the memory of n flights before their first decision: zeros."""
    return {name: np.zeros((n, *shape), np.float32) for name, shape in shapes.items()}


def outputs_of(actions: ActionSpec) -> int:
    """Return the number of outputs: a score for each discrete action, or the action itself."""
    return discrete_actions(actions) or continuous_numbers(actions)


class OnnxRuntime:
    """A network in ONNX Runtime, on the CPU. Implements `RecurrentRuntime`."""

    def __init__(
        self,
        model: bytes,
        observation: ObservationSpec,
        actions: ActionSpec,
        threads: int = 1,
        state: Shapes | None = None,
    ) -> None:
        """Open the bytes of an .onnx file with weights. Small networks need one thread.

        The network must take the observation, return the actions, and keep `state` between
        decisions; None = no memory. Raises ValueError if it is not ONNX, or inputs or outputs
        differ.
        """
        import onnxruntime

        onnxruntime.set_default_logger_severity(_ERRORS_ONLY)
        onnxruntime.disable_telemetry_events()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = _ERRORS_ONLY
        # A spinning thread must not take a core from telemetry.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(
                model, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # ONNX Runtime's errors share no other base class.
            raise ValueError(f"not a model that ONNX Runtime loads: {first_line(error)}") from None
        self._state = tuple(state or {})
        _check_signature(self._session, observation, actions, state or {})

    def infer(self, encoded: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return the outputs (n, k) for the arrays of a layout."""
        found: NDArray[np.float32] = self._session.run([ACTION], dict(encoded))[0]
        return found

    def step(
        self, encoded: Mapping[str, NDArray[Any]], memory: Memory
    ) -> tuple[NDArray[np.float32], Memory]:
        """Return the outputs (n, k) of a network with memory, and its next memory."""
        names = [ACTION, *(f"{NEXT}{name}" for name in self._state)]
        found, *after = self._session.run(names, {**encoded, **memory})
        return found, dict(zip(self._state, after, strict=True))


class TorchRuntime:
    """A network as a torch program (`torch.export`), on the CPU. Implements `RecurrentRuntime`."""

    def __init__(
        self,
        program: bytes,
        observation: ObservationSpec,
        threads: int = 1,
        state: Shapes | None = None,
    ) -> None:
        """Open the bytes of a .pt2 file; `threads` applies to the whole process.

        `state` is the memory between decisions; None = no memory. Raises ValueError if torch is not
        installed, or cannot load the program.
        """
        try:
            import torch
        except ImportError:
            raise ValueError("torch is not installed; pip install 'airl-mav[train]'") from None
        torch.set_num_threads(threads)
        try:
            self._module = torch.export.load(io.BytesIO(program)).module()
        except Exception as error:  # Any type, from a bad archive to an unknown operator.
            raise ValueError(f"not a program that torch loads: {first_line(error)}") from None
        self._torch = torch
        self._keys, self._state = tuple(boxes(observation)), tuple(state or {})

    def infer(self, encoded: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return the outputs (n, k) for the arrays of a layout."""
        with self._torch.inference_mode():
            found: NDArray[np.float32] = self._module(*self._tensors(encoded, self._keys)).numpy()
        return found

    def step(
        self, encoded: Mapping[str, NDArray[Any]], memory: Memory
    ) -> tuple[NDArray[np.float32], Memory]:
        """Return the outputs (n, k) of a network with memory, and its next memory."""
        with self._torch.inference_mode():
            tensors = self._tensors(encoded, self._keys) + self._tensors(memory, self._state)
            found, *after = (each.numpy() for each in self._module(*tensors))
        return found, dict(zip(self._state, after, strict=True))

    def _tensors(self, arrays: Mapping[str, NDArray[Any]], keys: tuple[str, ...]) -> list[Any]:
        return [self._torch.from_numpy(np.ascontiguousarray(arrays[key])) for key in keys]


def _check_signature(
    session: Any, observation: ObservationSpec, actions: ActionSpec, state: Shapes
) -> None:
    """Raise ValueError if a session's inputs or outputs differ from its card."""
    takes = {name: (_ONNX_TYPES[box.dtype], box.shape) for name, box in boxes(observation).items()}
    gives: dict[str, tuple[str, tuple[int, ...]]] = {
        ACTION: (_ONNX_TYPES[np.float32], (outputs_of(actions),))
    }
    for name, shape in state.items():
        takes[name] = gives[f"{NEXT}{name}"] = _ONNX_TYPES[np.float32], shape
    _compare("inputs", session.get_inputs(), takes)
    _compare("outputs", session.get_outputs(), gives)


def _compare(
    what: str, nodes: list[Any], wanted: Mapping[str, tuple[str, tuple[int, ...]]]
) -> None:
    """Compare inputs or outputs by name, type and shape; the first axis must be free."""
    found = {node.name: (node.type, tuple(node.shape)) for node in nodes}
    fits = found.keys() == wanted.keys() and all(
        found[name][0] == kind
        and found[name][1][1:] == shape
        and not isinstance(found[name][1][0], int)
        for name, (kind, shape) in wanted.items()
    )
    if not fits:
        accepted = {name: (kind, ("n", *shape)) for name, (kind, shape) in wanted.items()}
        raise ValueError(f"{what} {_signature(found)}; accepted: {_signature(accepted)}")


def _signature(nodes: Mapping[str, tuple[str, tuple[Any, ...]]]) -> str:
    return ", ".join(
        f"{name} {kind} ({', '.join(str(axis) for axis in shape)})"
        for name, (kind, shape) in nodes.items()
    )


def first_line(error: Exception) -> str:
    """Return the first line of an error."""
    return (str(error) or type(error).__name__).splitlines()[0]
