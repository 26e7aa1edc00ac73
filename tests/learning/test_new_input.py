"""An input of networks added as policy/layouts.py says: a row of `INPUTS`."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

from tests.support.processes import ROOT

POLICY = ROOT / "airl_mav" / "policy"
LAST_ROW = '    "height": Input('

ROW = """\
    "way": Input(2, "the position", lambda seen: seen.states[0].position[:, :2], (10.0, 10.0)),
"""

# Only this part of the package comes from the other tree, so that no kernel is compiled again.
FLIGHT = """\
import json, sys
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

import airl_mav.policy

airl_mav.policy.__path__.insert(0, sys.argv[1])

from airl_mav import rehearse
from airl_mav.policy.actions import ActionSpec
from airl_mav.policy.card import PolicyCard, digest
from airl_mav.policy.card_writing import write_card
from airl_mav.policy.layouts import INPUTS, boxes
from airl_mav.policy.observation_spec import ObservationSpec
from airl_mav.scenario.model import Scenario

out = Path(sys.argv[2])
spec = ObservationSpec(
    height_px=24, width_px=32, horizontal_fov_deg=90.0, range_m=20.0, in_flight=("way", "height")
)
types = {np.uint8: TensorProto.UINT8, np.float32: TensorProto.FLOAT}
# Forward until the vehicle is 12 m north of the start, then stop.
weights = {
    "matrix": np.array([[-50.0, 0.0, 0.0], [0.0, 0.0, 0.0]], np.float32),
    "bias": np.array([60.0, 0.0], np.float32),
}
graph = helper.make_graph(
    [helper.make_node("Gemm", ["in_flight", "matrix", "bias"], ["action"], transB=1)],
    "north",
    [
        helper.make_tensor_value_info(key, types[box.dtype], ["n", *box.shape])
        for key, box in boxes(spec).items()
    ],
    [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["n", 2])],
    [numpy_helper.from_array(value, name) for name, value in weights.items()],
)
model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
data = model.SerializeToString()
(out / "policy.onnx").write_bytes(data)
card = PolicyCard(
    name="north", observation=spec, actions=ActionSpec(set="velocity-fixed-yaw", max_speed_m_s=3.0),
    hold_s=0.2, goal_radius_m=2.0, altitude_m=2.5, sha256=digest(data), network="one layer",
    parameters=8, macs=6,
)
write_card(out, card)
run = rehearse(
    Scenario(
        level="gym", policy=str(out), arena="open-field", episodes=1, workers=1, time_limit_s=15.0
    ),
    out=out / "run",
)
print(json.dumps({
    "meaning": INPUTS["way"].meaning in ObservationSpec.model_fields["in_flight"].description,
    "ended": run.trajectories[0].position[-1].tolist(),
}))
"""


def test_an_input_is_added_with_one_row_and_flown_from_a_card(tmp_path: Path) -> None:
    changed = tmp_path / "policy"
    shutil.copytree(POLICY, changed, ignore=shutil.ignore_patterns("__pycache__"))
    table = (POLICY / "layouts.py").read_text()
    assert table.count(LAST_ROW) == 1
    (changed / "layouts.py").write_text(table.replace(LAST_ROW, ROW + LAST_ROW))

    files = [path.relative_to(changed) for path in changed.rglob("*.py")]
    edited = [f for f in files if (POLICY / f).read_bytes() != (changed / f).read_bytes()]
    assert edited == [Path("layouts.py")]

    flown = tmp_path / "north"
    flown.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", FLIGHT, str(changed), str(flown)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["meaning"]
    north, east, _ = found["ended"]
    assert 11.0 < north < 14.0, found
    assert abs(east) < 3.0, found
