"""What runs a network: ONNX Runtime, or torch where it is installed.

Both are imported only when a network is opened: a classical policy needs neither.

A network with a memory takes what it remembers as further inputs, and gives what it will remember
as further outputs, whose names begin with `next_`. It keeps nothing itself: one runtime serves any
number of flights.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from airl_mav.policy.action_sets import ActionSpec, continuous_numbers, discrete_actions
from airl_mav.policy.layouts import boxes
from airl_mav.policy.observation_spec import ObservationSpec

RuntimeName = Literal["onnx", "torch"]

ACTION = "action"
"""Name of the output that decides: the only one of a network without memory."""

NEXT = "next_"
"""What the name of a memory's output begins with; the rest is the name of its input."""

Shapes = Mapping[str, tuple[int, ...]]
"""What a network remembers: the shape of each array by name, without the leading axis."""

Memory = dict[str, NDArray[np.float32]]
"""What the networks of n flights remember: arrays of n rows by name."""

_ERRORS_ONLY = 3
"""ONNX Runtime's severity: warnings about the machine are not for the pilot."""

_ONNX_TYPES: dict[type[np.generic], str] = {
    np.uint8: "tensor(uint8)",
    np.float32: "tensor(float)",
}


class Runtime(Protocol):
    """A network ready to infer."""

    def infer(self, encoded: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return the outputs (n, k) for the arrays of a layout, each with n rows."""


@runtime_checkable
class RecurrentRuntime(Runtime, Protocol):
    """One that also runs networks with a memory."""

    def step(
        self, encoded: Mapping[str, NDArray[Any]], memory: Memory
    ) -> tuple[NDArray[np.float32], Memory]:
        """Return the outputs (n, k) of a network with a memory, and what it will remember."""


def blank_memory(shapes: Shapes, n: int) -> Memory:
    """Return what the networks of n flights remember before their first decision: zeros."""
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
        """Open the bytes of an .onnx file that holds its weights. Small networks need one thread.

        It must take the observation, give the actions, and remember `state` between decisions,
        None: nothing. Raises ValueError if it is no ONNX, or has other inputs or outputs.
        """
        import onnxruntime

        onnxruntime.set_default_logger_severity(_ERRORS_ONLY)
        onnxruntime.disable_telemetry_events()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = _ERRORS_ONLY
        # A waiting thread must not burn a core that telemetry needs.
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
        """Return the outputs (n, k) of a network with a memory, and what it will remember."""
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
        """Open the bytes of a .pt2 file; `threads` count for the whole process.

        It remembers `state` between decisions, None: nothing. Raises ValueError if torch is not
        installed, or cannot load the program.
        """
        try:
            import torch
        except ImportError:
            raise ValueError("torch is not installed; pip install 'airl-mav[train]'") from None
        torch.set_num_threads(threads)
        try:
            self._module = torch.export.load(io.BytesIO(program)).module()
        except Exception as error:  # Anything, from a bad archive to an unknown operator.
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
        """Return the outputs (n, k) of a network with a memory, and what it will remember."""
        with self._torch.inference_mode():
            tensors = self._tensors(encoded, self._keys) + self._tensors(memory, self._state)
            found, *after = (each.numpy() for each in self._module(*tensors))
        return found, dict(zip(self._state, after, strict=True))

    def _tensors(self, arrays: Mapping[str, NDArray[Any]], keys: tuple[str, ...]) -> list[Any]:
        return [self._torch.from_numpy(np.ascontiguousarray(arrays[key])) for key in keys]


def _check_signature(
    session: Any, observation: ObservationSpec, actions: ActionSpec, state: Shapes
) -> None:
    """Raise ValueError unless a session takes and gives what its card says."""
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
