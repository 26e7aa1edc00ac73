"""Random networks of the paper's template, against torch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from airl_mav.policy.actions import ActionSpec
from airl_mav.policy.card import OnnxRuntime, PolicyFacts, load_card
from airl_mav.policy.card_writing import build_template, template_size, write_template
from airl_mav.policy.observation_spec import ObservationSpec

onnx = pytest.importorskip("onnx")
torch = pytest.importorskip("torch")

SPEC = ObservationSpec(width_px=16, height_px=12, horizontal_fov_deg=90.0, range_m=20.0)


@pytest.mark.parametrize(("layers", "filters"), [(1, 1), (2, 4), (5, 32)])
def test_size_is_that_of_the_trained_template(layers: int, filters: int) -> None:
    from airl_mav.training.config import NetworkSpec
    from tests.support.policy_kit import parameters_of

    spec = NetworkSpec(kind="template", layers=layers, filters=filters)
    found = template_size(layers, filters, 154, 256, 25)
    assert found.parameters == parameters_of(spec, 154, 256)


def test_multiply_accumulates_of_a_small_one_by_hand() -> None:
    # 2 filters over 12 px: 9 x 1 x 2 x 12, then (24 + 6) x 2, then 2 x 25.
    assert template_size(1, 2, 3, 4, 25).macs == 216 + 60 + 50


def test_it_computes_what_torch_computes() -> None:
    from torch.nn import functional

    model = build_template(3, 5, SPEC, ActionSpec(), np.random.default_rng(1))
    rng = np.random.default_rng(2)
    inputs = {
        "depth": rng.integers(0, 256, (2, 1, 12, 16), np.uint8),
        "velocity": rng.standard_normal((2, 3), np.float32),
        "goal": rng.standard_normal((2, 3), np.float32),
    }
    found = OnnxRuntime(model, SPEC, ActionSpec()).infer(inputs)
    weights = {
        w.name: torch.from_numpy(onnx.numpy_helper.to_array(w).copy())
        for w in onnx.load_from_string(model).graph.initializer
    }
    x = torch.from_numpy(inputs["depth"]).float() / 255.0
    for k in range(3):
        layer = weights[f"conv{k}.weight"], weights[f"conv{k}.bias"]
        x = functional.relu(functional.conv2d(x, *layer, padding="same"))
    vectors = [torch.from_numpy(inputs[key]) for key in ("velocity", "goal")]
    x = torch.cat([x.flatten(1), *vectors], 1)
    for k in range(3):
        layer = weights[f"dense{k}.weight"], weights[f"dense{k}.bias"]
        x = functional.relu(functional.linear(x, *layer))
    wanted = functional.linear(x, weights["score.weight"], weights["score.bias"]).numpy()
    assert found.shape == (2, 25)
    assert np.abs(found).max() > 0.01
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)


def test_same_seed_same_file(tmp_path: Path) -> None:
    facts = PolicyFacts(
        name="random", observation=SPEC, hold_s=0.5, goal_radius_m=3.0, altitude_m=2.5
    )
    digests = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        folder = tmp_path / name
        folder.mkdir()
        card = write_template(folder, 2, 4, facts, np.random.default_rng(seed))
        assert load_card(folder) == card
        digests.append(card.sha256)
    assert digests[0] == digests[1] != digests[2]
