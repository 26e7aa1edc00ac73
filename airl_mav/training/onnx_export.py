"""Export of a trained network to a policy folder: ONNX and card, checked against torch.

Recurrent policies of sb3-contrib are exported as their actor, with its memory as inputs and
outputs. The LSTM is unrolled to one step, so that an export has only products and sums and any
batch size.
"""

from __future__ import annotations

import copy
import inspect
import io
import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn
from torch.nn import functional

from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.policy.card import (
    ACTION,
    NEXT,
    ONNX_FILE,
    TORCH_FILE,
    Memory,
    OnnxRuntime,
    PolicyCard,
    PolicyFacts,
    Runtime,
    Shapes,
    TorchRuntime,
    digest,
    first_line,
)
from airl_mav.policy.card_writing import write_card
from airl_mav.policy.layouts import Encoded, boxes
from airl_mav.policy.observation_spec import ObservationSpec

OPSET = 18
"""ONNX operator set: the newest that torch writes without a conversion."""

TOLERANCE = 1e-4
"""Maximum error of an exported output, as a share of the maximum output (at least 1)."""

CHECKED_ROWS = (1, 3, 64)
"""Batch sizes to compare a network and its export."""


class Layer(NamedTuple):
    """A layer executed in an inference."""

    text: str
    macs: int


def inspect_network(module: nn.Module, inputs: tuple[torch.Tensor, ...]) -> tuple[list[Layer], int]:
    """Run a network on single-row inputs; return its layers in order and parameter count."""
    layers: list[Layer] = []
    weights: dict[int, int] = {}

    def note(part: nn.Module, _: Any, output: torch.Tensor) -> None:
        weights.update((id(each), each.numel()) for each in part.parameters(recurse=False))
        if isinstance(part, nn.Conv2d):
            kernel = "x".join(str(side) for side in part.kernel_size)
            stride = "" if set(part.stride) == {1} else f"/{part.stride[0]}"
            text = f"conv {part.out_channels} {kernel}{stride}"
            layers.append(Layer(text, output.numel() * part.weight[0].numel()))
        elif isinstance(part, nn.Linear):
            layers.append(Layer(f"dense {part.out_features}", output.numel() * part.in_features))
        elif isinstance(part, LstmStep):
            products = part.input_weight.numel() + part.hidden_weight.numel()
            layers.append(Layer(f"lstm {part.units}", len(output[0]) * products))

    hooks = [part.register_forward_hook(note) for part in module.modules()]
    try:
        with torch.no_grad():
            module(*inputs)
    finally:
        for hook in hooks:
            hook.remove()
    return layers, sum(weights.values())


def export_network(
    module: nn.Module, facts: PolicyFacts, folder: Path, *, with_torch: bool = False
) -> PolicyCard:
    """Write a network as `export.export_sb3` does a model, and return its card.

    Inputs are the image (`depth`, `rgb` or `grey`; (n, channels, h, w) uint8), `velocity` and
    `goal` (n, 3) float32, or (n, 4) with the goal's height. The output is a score per discrete
    action (n, k), or the continuous action (n, 2), in three dimensions (n, 3). The network scales
    the image itself. Memory is passed as additional inputs and outputs, with shapes in the
    attribute `state` (`RecurrentNetwork`).

    Nothing is written unless ONNX Runtime and torch agree. After a kill there is no card, or an old
    card that rejects the new policy: never a card for the wrong one. Raises UsageError if the
    network does not fit the facts, cannot be exported, or the export differs.
    """
    spec, state = facts.observation, memory_of(module)
    rng = np.random.default_rng(0)
    example = _tensors(spec, random_inputs(spec, 2, rng), random_memory(state, 2, rng))
    with _quiet():
        try:
            module = copy.deepcopy(module).cpu().eval()
            program = _program(module, example)
            onnx = _onnx(program, [*boxes(spec), *state], state)
        except Exception as error:  # torch's exporter raises arbitrary exceptions.
            raise UsageError(f"torch cannot export the network: {first_line(error)}") from error
        archive = _archive(program) if with_torch else None
    try:
        runtime = OnnxRuntime(onnx, spec, facts.actions, state=state)
        _compare(module, runtime, spec, "ONNX Runtime")
        if archive is not None:
            _compare(module, TorchRuntime(archive, spec, state=state), spec, "the torch program")
    except ValueError as error:
        raise UsageError(f"the exported network: {error}") from None
    layers, parameters = inspect_network(module, tuple(tensor[:1] for tensor in example))
    card = PolicyCard(
        **{name: getattr(facts, name) for name in PolicyFacts.model_fields},
        sha256=digest(onnx),
        torch_sha256=None if archive is None else digest(archive),
        state=dict(state),
        network=", ".join(layer.text for layer in layers),
        parameters=parameters,
        macs=sum(layer.macs for layer in layers),
    )
    folder.mkdir(parents=True, exist_ok=True)
    replace_file(folder / ONNX_FILE, onnx)
    if archive is not None:
        replace_file(folder / TORCH_FILE, archive)
    write_card(folder, card)
    if archive is None:
        (folder / TORCH_FILE).unlink(missing_ok=True)
    return card


def random_inputs(spec: ObservationSpec, n: int, rng: np.random.Generator) -> Encoded:
    """Return arrays of a layout with n rows of noise."""
    return {
        key: rng.integers(0, 256, (n, *box.shape), np.uint8)
        if np.dtype(box.dtype) == np.uint8
        else rng.normal(0.0, 2.0, (n, *box.shape)).astype(np.float32)
        for key, box in boxes(spec).items()
    }


def random_memory(state: Shapes, n: int, rng: np.random.Generator) -> Memory:
    """Return random memories of n networks between -1 and 1; empty without memory."""
    return {
        name: rng.uniform(-1.0, 1.0, (n, *shape)).astype(np.float32)
        for name, shape in state.items()
    }


def memory_of(module: nn.Module) -> Shapes:
    """Return the memory shapes of a network; empty without memory."""
    return module.state if isinstance(module, RecurrentNetwork) else {}


def _compare(module: nn.Module, runtime: Runtime, spec: ObservationSpec, name: str) -> None:
    """Raise ValueError unless a runtime and the network have the same outputs."""
    rng = np.random.default_rng(1)
    for n in CHECKED_ROWS:
        inputs, memory = random_inputs(spec, n, rng), random_memory(memory_of(module), n, rng)
        with torch.no_grad():
            given = module(*_tensors(spec, inputs, memory))
        if memory:
            outputs, after = runtime.step(inputs, memory)
            pairs = list(zip([outputs, *after.values()], given, strict=True))
        else:
            pairs = [(runtime.infer(inputs), given)]
        for found, tensor in pairs:
            _compare_arrays(found, tensor.numpy(), name)


def _compare_arrays(found: NDArray[np.float32], wanted: NDArray[np.float32], name: str) -> None:
    if found.shape != wanted.shape or not np.isfinite(wanted).all():
        raise ValueError(f"torch gives {wanted.shape}, {name} {found.shape}, or no numbers")
    error = float(np.abs(found - wanted).max())
    if not error <= TOLERANCE * max(1.0, float(np.abs(wanted).max())):
        raise ValueError(f"{name} is off by {error:.3g}; accepted: {TOLERANCE:g} of the output")


def _program(module: nn.Module, example: tuple[torch.Tensor, ...]) -> torch.export.ExportedProgram:
    """Trace a network with a free number of rows, without the paths of this machine."""
    rows = {0: torch.export.Dim("n", min=1)}
    free: Any = tuple(rows for _ in example)
    if len(inspect.signature(module.forward).parameters) < len(example):
        # A single variadic parameter.
        free = (free,)
    program = torch.export.export(module, example, dynamic_shapes=free)
    for node in program.graph.nodes:
        node.meta.pop("stack_trace", None)
    return program


def _onnx(program: torch.export.ExportedProgram, inputs: list[str], state: Shapes) -> bytes:
    """Convert a program to ONNX with weights, without the source locations of operators."""
    written = torch.onnx.export(
        program,
        args=(),
        dynamo=True,
        opset_version=OPSET,
        external_data=False,
        input_names=inputs,
        output_names=[ACTION, *(f"{NEXT}{name}" for name in state)],
        verbose=False,
    )
    assert written is not None  # noqa: S101 (None only with the old exporter)
    model = written.model_proto
    graph = model.graph
    graph.ClearField("metadata_props")
    graph.ClearField("value_info")
    for entry in (*graph.node, *graph.input, *graph.output, *graph.initializer):
        entry.ClearField("metadata_props")
        entry.ClearField("doc_string")
    for value in (*graph.input, *graph.output):
        value.type.tensor_type.shape.dim[0].dim_param = "n"
    data: bytes = model.SerializeToString(deterministic=True)
    return data


def _archive(program: torch.export.ExportedProgram) -> bytes:
    """Return a program as the bytes of a .pt2 file."""
    buffer = io.BytesIO()
    torch.export.save(program, buffer)
    return buffer.getvalue()


def _tensors(spec: ObservationSpec, inputs: Encoded, memory: Memory) -> tuple[torch.Tensor, ...]:
    arrays = [*(inputs[key] for key in boxes(spec)), *memory.values()]
    return tuple(torch.from_numpy(array) for array in arrays)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the deprecation warnings of torch's exporter."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


HIDDEN, CELL = "hidden", "cell"
"""Names of the two memory arrays (n, layers, units) of an LSTM."""


class LstmStep(nn.Module):
    """One layer of an LSTM, one step: hidden' and cell' (n, units) of inputs, hidden and cell."""

    def __init__(self, lstm: nn.LSTM, layer: int) -> None:
        super().__init__()
        self.units = lstm.hidden_size
        self.input_weight = getattr(lstm, f"weight_ih_l{layer}")
        self.hidden_weight = getattr(lstm, f"weight_hh_l{layer}")
        self.input_bias = getattr(lstm, f"bias_ih_l{layer}")
        self.hidden_bias = getattr(lstm, f"bias_hh_l{layer}")

    def forward(
        self, seen: torch.Tensor, hidden: torch.Tensor, cell: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the layer's output, which is the next hidden, and the next cell."""
        gates = functional.linear(seen, self.input_weight, self.input_bias)
        gates = gates + functional.linear(hidden, self.hidden_weight, self.hidden_bias)
        # torch's order of the gates.
        take, keep, new, show = gates.chunk(4, dim=1)
        cell = torch.sigmoid(keep) * cell + torch.sigmoid(take) * torch.tanh(new)
        return torch.sigmoid(show) * torch.tanh(cell), cell


class RecurrentNetwork(nn.Module):
    """From arrays in the order of their keys, hidden and cell to outputs, next hidden and cell."""

    def __init__(
        self, features: nn.Module, lstm: nn.LSTM, head: nn.Module, keys: Sequence[str]
    ) -> None:
        """Connect features of Dict observations, LSTM and output head."""
        super().__init__()
        self.keys = tuple(keys)
        self.features = features
        self.steps = nn.ModuleList(LstmStep(lstm, layer) for layer in range(lstm.num_layers))
        self.head = head
        shape = (lstm.num_layers, lstm.hidden_size)
        self.state: Shapes = {HIDDEN: shape, CELL: shape}

    def forward(self, *arrays: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the outputs (n, k), and hidden and cell (n, layers, units) after the decision."""
        *seen, hidden, cell = arrays
        found = self.features(dict(zip(self.keys, seen, strict=True)))
        hiddens, cells = [], []
        for layer, step in enumerate(self.steps):
            found, kept = step(found, hidden[:, layer], cell[:, layer])
            hiddens.append(found)
            cells.append(kept)
        return self.head(found), torch.stack(hiddens, dim=1), torch.stack(cells, dim=1)


class GreedyDecisions:
    """Greedy decisions of a learner, n flights at a time; `began` resets a flight's memory."""

    def __init__(self, model: BaseAlgorithm) -> None:
        self._model = model
        self._state: tuple[NDArray[Any], ...] | None = None
        self._new: set[int] = set()

    def began(self, slot: int) -> None:
        """Mark the start of an episode in a slot."""
        self._new.add(slot)

    def __call__(self, seen: Encoded) -> NDArray[Any]:
        """Return the actions of n vehicles."""
        starts = np.zeros(len(next(iter(seen.values()))), np.bool_)
        starts[list(self._new)] = True
        self._new.clear()
        actions, self._state = self._model.predict(
            seen, self._state, episode_start=starts, deterministic=True
        )
        return actions
