"""Randomly initialised networks of the paper's template, written as ONNX without torch.

L convolutions of F filters (3x3, stride 1, same padding), joined with velocity and goal, L dense
layers of F units, a score for each action (Krishnan et al., Air Learning, 2021). The inference time
depends on the layers' sizes, not on the weights.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.core.errors import UsageError
from airl_mav.core.files import replace_file
from airl_mav.policy.action_sets import ActionSpec
from airl_mav.policy.card import ONNX_FILE, PolicyCard, PolicyFacts, digest
from airl_mav.policy.card_writing import write_card
from airl_mav.policy.layouts import GOAL, VELOCITY
from airl_mav.policy.observation_spec import ObservationSpec
from airl_mav.policy.runtime import ACTION, outputs_of

OPSET = 18
IR_VERSION = 10
"""ONNX file format, supported since ONNX Runtime 1.18."""

KERNEL = 3
VECTOR_INPUTS = 6
"""Length of velocity and goal; one more with the goal's height."""
GREATEST_BYTES = 1_900_000_000
"""Maximum size of an .onnx file with weights, below the encoding's limit of 2 GiB."""


class NetworkSize(NamedTuple):
    """Size of a network."""

    parameters: int
    macs: int
    """Multiply-accumulates of one inference."""


def template_size(
    layers: int,
    filters: int,
    height_px: int,
    width_px: int,
    outputs: int,
    channels: int = 1,
    vector_inputs: int = VECTOR_INPUTS,
) -> NetworkSize:
    """Return the size of a network of the template; `channels` is the number of image channels."""
    pixels = height_px * width_px
    weights, biases, macs = 0, 0, 0
    for _ in range(layers):
        kernel = KERNEL * KERNEL * channels * filters
        weights, biases, macs = weights + kernel, biases + filters, macs + kernel * pixels
        channels = filters
    inputs = filters * pixels + vector_inputs
    for units in (*[filters] * layers, outputs):
        weights, biases, macs = weights + inputs * units, biases + units, macs + inputs * units
        inputs = units
    return NetworkSize(weights + biases, macs)


def write_template(
    folder: Path, layers: int, filters: int, facts: PolicyFacts, rng: np.random.Generator
) -> PolicyCard:
    """Write a random network of the template and its card to an existing folder.

    The network has `layers` >= 1 convolutions of `filters` filters, and as many dense layers.
    Raises UsageError if it is too large for one .onnx file.
    """
    spec, outputs = facts.observation, outputs_of(facts.actions)
    shape, vectors = spec.image_shape, _vector_inputs(spec)
    size = template_size(layers, filters, *shape, outputs, spec.channels, vectors)
    if 4 * size.parameters > GREATEST_BYTES:
        raise UsageError(
            f"--network {layers}x{filters}: {size.parameters:,} parameters; accepted: at most "
            f"{GREATEST_BYTES // 4:,} (a smaller --image has fewer)"
        )
    model = build_template(layers, filters, spec, facts.actions, rng)
    replace_file(folder / ONNX_FILE, model)
    card = PolicyCard(
        **{name: getattr(facts, name) for name in PolicyFacts.model_fields},
        sha256=digest(model),
        network=f"{layers} x conv {filters} 3x3, {layers} x dense {filters}, dense {outputs}",
        parameters=size.parameters,
        macs=size.macs,
    )
    write_card(folder, card)
    return card


def _vector_inputs(spec: ObservationSpec) -> int:
    return VECTOR_INPUTS - 3 + spec.goal_numbers


def build_template(
    layers: int,
    filters: int,
    spec: ObservationSpec,
    actions: ActionSpec,
    rng: np.random.Generator,
) -> bytes:
    """Return a random network of the template as the bytes of an .onnx file.

    Weights are He-initialized (normal, variance 2 / inputs), so that signals keep their scale.
    """
    # Imported late: only the [profile] and [train] extras install it.
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes: list[Any] = []
    weights: list[Any] = []

    def add(name: str, values: NDArray[np.float32]) -> str:
        weights.append(numpy_helper.from_array(values, name))
        return name

    def random(name: str, shape: tuple[int, ...]) -> str:
        scale = np.float32(np.sqrt(2.0 / np.prod(shape[1:])))
        return add(name, rng.standard_normal(shape, np.float32) * scale)

    def zeros(name: str, count: int) -> str:
        return add(name, np.zeros(count, np.float32))

    def node(operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    full = add("full_scale", np.array(255.0, np.float32))
    x = node("Div", [node("Cast", [spec.kind], "pixels", to=TensorProto.FLOAT), full], "image")
    channels = spec.channels
    for k in range(layers):
        kernel = random(f"conv{k}.weight", (filters, channels, KERNEL, KERNEL))
        x = node(
            "Conv",
            [x, kernel, zeros(f"conv{k}.bias", filters)],
            f"conv{k}",
            kernel_shape=[KERNEL, KERNEL],
            pads=[KERNEL // 2] * 4,
        )
        x = node("Relu", [x], f"conv{k}.relu")
        channels = filters
    flat = node("Flatten", [x], "flat", axis=1)
    x = node("Concat", [flat, VELOCITY, GOAL], "joined", axis=1)
    inputs = filters * math.prod(spec.image_shape) + _vector_inputs(spec)
    for k in range(layers):
        dense = [x, random(f"dense{k}.weight", (filters, inputs)), zeros(f"dense{k}.bias", filters)]
        x = node("Relu", [node("Gemm", dense, f"dense{k}", transB=1)], f"dense{k}.relu")
        inputs = filters
    outputs = outputs_of(actions)
    last = [x, random("score.weight", (outputs, inputs)), zeros("score.bias", outputs)]
    node("Gemm", last, ACTION, transB=1)
    image = ["n", spec.channels, *spec.image_shape]
    graph = helper.make_graph(
        nodes,
        "template",
        [
            helper.make_tensor_value_info(spec.kind, TensorProto.UINT8, image),
            helper.make_tensor_value_info(VELOCITY, TensorProto.FLOAT, ["n", 3]),
            helper.make_tensor_value_info(GOAL, TensorProto.FLOAT, ["n", spec.goal_numbers]),
        ],
        [helper.make_tensor_value_info(ACTION, TensorProto.FLOAT, ["n", outputs])],
        weights,
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
    )
    onnx.checker.check_model(model)
    data: bytes = model.SerializeToString(deterministic=True)
    return data
