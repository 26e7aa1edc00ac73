"""Policies that fail: ONNX models built node by node, in folders with a valid card."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from airl_mav.profiles.loading import profiles_dir

CARD = profiles_dir() / "policies" / "static-obstacles" / "card.json"
ACTIONS = 25
FORWARD = 22
"""Action of arc-25: straight ahead, at full speed."""

Nodes = list[onnx.NodeProto]
INT64, FLOAT, BOOL = TensorProto.INT64, TensorProto.FLOAT, TensorProto.BOOL


def node(kind: str, inputs: str, outputs: str, **attributes: Any) -> onnx.NodeProto:
    """Return a node; inputs and outputs are separated by spaces."""
    return helper.make_node(kind, inputs.split(), outputs.split(), **attributes)


def constant(name: str, value: Any, dtype: Any = np.float32) -> onnx.NodeProto:
    """Return a node with a constant output."""
    return node("Constant", "", name, value=numpy_helper.from_array(np.array(value, dtype)))


def model(nodes: Sequence[onnx.NodeProto], **graph: Any) -> bytes:
    """Return a model of the card's inputs; the nodes take `scores` and return `action`."""
    scores = np.zeros((3, ACTIONS), np.float32)
    bias = np.zeros(ACTIONS, np.float32)
    bias[FORWARD] = 1.0
    first = [
        constant("weights", scores),
        constant("bias", bias),
        node("Gemm", "velocity weights bias", "scores"),
    ]
    inputs = [
        helper.make_tensor_value_info("depth", TensorProto.UINT8, ["n", 1, 24, 32]),
        helper.make_tensor_value_info("velocity", FLOAT, ["n", 3]),
        helper.make_tensor_value_info("goal", FLOAT, ["n", 3]),
    ]
    outputs = [helper.make_tensor_value_info("action", FLOAT, ["n", ACTIONS])]
    made = helper.make_graph([*first, *nodes], "policy", inputs, outputs, **graph)
    return bytes(
        helper.make_model(
            made, ir_version=10, opset_imports=[helper.make_opsetid("", 18)]
        ).SerializeToString()
    )


def write_policy(folder: Path, data: bytes, **changes: Any) -> Path:
    """Write a policy folder with a card for the model, with changes; return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    card = json.loads(CARD.read_text())
    card.pop("crc32", None)
    card |= {"name": folder.name, "sha256": hashlib.sha256(data).hexdigest(), **changes}
    (folder / "card.json").write_text(json.dumps(card))
    (folder / "policy.onnx").write_bytes(data)
    return folder


def loop(trips: str) -> Nodes:
    """Return nodes that add zero to the scores in a loop; `trips` is its number."""
    body = helper.make_graph(
        [node("Identity", "on", "on_out"), node("Sin", "x", "y")],
        "body",
        [
            helper.make_tensor_value_info("i", INT64, []),
            helper.make_tensor_value_info("on", BOOL, []),
            helper.make_tensor_value_info("x", FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("on_out", BOOL, []),
            helper.make_tensor_value_info("y", FLOAT, None),
        ],
    )
    return [
        constant("true", True, np.bool_),
        node("Loop", f"{trips} true scores", "turned", body=body),
        node("Add", "scores turned", "action"),
    ]


def moving(gain: float) -> Nodes:
    """Return nodes for `m` (n, 1): zero at velocities 0 and 1, as in a trial; else positive."""
    return [
        constant("gain", gain),
        constant("one", 1.0),
        node("Sub", "one velocity", "rest"),
        node("Mul", "velocity rest", "bump"),
        node("Abs", "bump", "bumps"),
        constant("axis", [1], np.int64),
        node("ReduceMax", "bumps axis", "peak"),
        node("Mul", "peak gain", "m"),
    ]


def infinite_trips() -> Nodes:
    return [constant("trips", 2**62, np.int64), *loop("trips")]


MODELS: Mapping[str, Callable[[], Nodes]] = {
    "sound": lambda: [node("Identity", "scores", "action")],
    "nan": lambda: [constant("nan", np.nan), node("Add", "scores nan", "action")],
    "huge": lambda: [
        constant("shape", [10_000_000_000], np.int64),
        node("ConstantOfShape", "shape", "giant"),
        node("ReduceMax", "giant", "most", keepdims=0),
        node("Add", "scores most", "action"),
    ],
    "endless": infinite_trips,
    "slow": lambda: [constant("trips", 300_000_000, np.int64), *loop("trips")],
    "wide": lambda: [node("Concat", "scores scores", "action", axis=1)],
    "rows": lambda: [node("Concat", "scores scores", "action", axis=0)],
    "raises": lambda: [
        constant("far", [99], np.int64),
        constant("table", [0.0] * ACTIONS),
        node("Cast", "velocity", "whole", to=INT64),
        node("ReduceSum", "whole", "sum", keepdims=0),
        node("Add", "sum far", "index"),
        node("Gather", "table index", "found"),
        node("Add", "scores found", "action"),
    ],
    "nan later": lambda: [
        *moving(100.0),
        node("Sub", "one m", "negative"),
        node("Sqrt", "negative", "root"),
        node("Add", "scores root", "action"),
    ],
    "raises later": lambda: [
        *moving(1_000.0),
        constant("table", [0.0]),
        node("Cast", "m", "index", to=INT64),
        node("Gather", "table index", "found"),
        node("Add", "scores found", "action"),
    ],
    "endless later": lambda: [
        *moving(2.0**40),
        node("ReduceMax", "m", "longest", keepdims=0),
        node("Cast", "longest", "trips", to=INT64),
        *loop("trips"),
    ],
}
"""Nodes of each model by name; those "later" pass a trial and fail in flight."""


def write(folder: Path, name: str, **changes: Any) -> Path:
    """Write a policy of `MODELS`, in a folder of its name; return it."""
    return write_policy(folder / name.replace(" ", "-"), model(MODELS[name]()), **changes)


def abort(_: bytes) -> str:
    """End the process with SIGABRT, as a defect in a runtime does."""
    os.abort()


def devour(_: bytes) -> str:
    """Take all memory."""
    return str(len(bytearray(1 << 42)))
