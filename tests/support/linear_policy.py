"""A policy made by hand: one linear layer that flies to the goal and slows down before things.

Of each discrete action the score is how near its speed v and yaw rate w are to the wanted ones V
and W: -(v - V)² grows with 2 v V - v², which is linear in V; the same for W.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from airl_mav.policy.actions import ActionSpec, commands
from airl_mav.policy.card import CARD_FILE, ONNX_FILE, PolicyCard, PolicyFacts, Training, digest
from airl_mav.policy.card_writing import write_card
from airl_mav.policy.observation_spec import ObservationSpec

SPEC = ObservationSpec(height_px=24, width_px=32, horizontal_fov_deg=90.0, range_m=20.0)
ACTIONS = ActionSpec(set="arc-25", max_speed_m_s=5.0)
PIXELS = SPEC.height_px * SPEC.width_px


def weights() -> tuple[np.ndarray, np.ndarray]:
    """Return matrix (25, pixels + 6) and bias (25,) of the layer."""
    table = commands(ACTIONS, np.arange(25))
    speed, turn = table[:, 0], table[:, 2]
    # Wanted yaw rate: 1.2 rad/s times the sine of the bearing, less by the drift to the right.
    wanted_turn = np.zeros(PIXELS + 6)
    wanted_turn[PIXELS + 4], wanted_turn[PIXELS + 1] = 1.2, -0.5
    # Desired speed: rises with free space ahead, and with a goal ahead and far away.
    ahead = np.zeros((SPEC.height_px, SPEC.width_px))
    ahead[8:14, 10:22] = 3.0 / (6 * 12)
    wanted_speed = np.zeros(PIXELS + 6)
    wanted_speed[:PIXELS] = ahead.ravel()
    wanted_speed[PIXELS + 3], wanted_speed[PIXELS + 5] = 1.0, 0.4
    matrix = 2.0 * (np.outer(speed, wanted_speed) + 4.0 * np.outer(turn, wanted_turn))
    bias = -(speed**2) - 4.0 * turn**2
    return matrix.astype(np.float32), bias.astype(np.float32)


def model(offset: float = 0.0) -> bytes:
    """Return the policy as ONNX, with an offset of all outputs; NaN gives no numbers."""
    matrix, bias = weights()
    bias = bias + np.float32(offset)
    nodes = [
        helper.make_node("Cast", ["depth"], ["bytes"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["bytes", "scale"], ["grey"]),
        helper.make_node("Flatten", ["grey"], ["flat"], axis=1),
        helper.make_node("Concat", ["flat", "velocity", "goal"], ["all"], axis=1),
        helper.make_node("Gemm", ["all", "matrix", "bias"], ["action"], transB=1),
    ]
    arrays = {"matrix": matrix, "bias": bias, "scale": np.float32(1.0 / 255.0)}
    graph = helper.make_graph(
        nodes,
        "linear",
        [
            helper.make_tensor_value_info(
                "depth", TensorProto.UINT8, ["n", 1, SPEC.height_px, SPEC.width_px]
            ),
            helper.make_tensor_value_info("velocity", TensorProto.FLOAT, ["n", 3]),
            helper.make_tensor_value_info("goal", TensorProto.FLOAT, ["n", 3]),
        ],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["n", 25])],
        [numpy_helper.from_array(np.asarray(a), name) for name, a in arrays.items()],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(made)
    data: bytes = made.SerializeToString()
    return data


def write_linear(folder: Path, *, offset: float = 0.0, **changes: Any) -> Path:
    """Write the policy with its card; changes go to the card's facts."""
    folder.mkdir(parents=True, exist_ok=True)
    data = model(offset)
    (folder / ONNX_FILE).write_bytes(data)
    known: dict[str, Any] = {
        "name": "linear",
        "description": "made by hand",
        "observation": SPEC,
        "actions": ACTIONS,
        "hold_s": 0.4,
        "goal_radius_m": 2.5,
        "altitude_m": 2.0,
        "training": Training(arena="no-obstacles"),
    }
    facts = PolicyFacts(**(known | changes))
    card = PolicyCard(
        **facts.model_dump(),
        sha256=digest(data),
        network="one linear layer",
        parameters=25 * (PIXELS + 7),
        macs=25 * (PIXELS + 6),
    )
    write_card(folder, card)
    assert (folder / CARD_FILE).exists()
    return folder
