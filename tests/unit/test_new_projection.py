"""A projection added as `profiles/projections.py` says: a class, and a line in `PROJECTIONS`."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

from tests.support.processes import ROOT

PROFILES = ROOT / "airl_mav" / "profiles"
LAST_LINE = '    "fisheye": Fisheye(),\n'
TABLE = "PROJECTIONS: Final"

LINE = '    "stereographic": Stereographic(),\n'

CLASS = '''\
class Stereographic(ProjectionModel):
    """The angle off the axis is 2 atan(r / (2 focal)), at a distance r in the image."""

    magic, accepted_fov = "S", "value <= 200 deg"

    def accepts(self, fov_deg):
        return fov_deg <= 200.0

    def focal(self, width, fov, distortion):
        return 0.25 * width / math.tan(0.25 * fov)

    def fov(self, k):
        return 4.0 * math.atan(0.25 * k.width / k.focal)

    def rays(self, k):
        across, down = _scaled_grid(k)
        out = np.hypot(across, down)
        off = 2.0 * np.arctan(0.5 * out)
        share = np.divide(np.sin(off), out, out=np.ones_like(out), where=out > 0.0)
        return np.stack([np.cos(off), across * share, down * share])

    def places(self, k, points):
        scale = 2.0 * k.focal / (np.sqrt((points**2).sum(axis=0)) + points[0])
        return points[1] * scale + k.cx, points[2] * scale + k.cy

    def flow(self, k, points, moves):
        (before, above), (after, below) = (
            self.places(k, points + step * moves) for step in (-1e-6, 1e-6)
        )
        return (after - before) / 2e-6, (below - above) / 2e-6


'''

# Only the profiles come from the other tree, so that no kernel of the project is compiled again.
SEEN = """\
import json, sys

import airl_mav.profiles.loading

airl_mav.profiles.__path__.insert(0, sys.argv[1])

import numpy as np

from airl_mav.arena.geometry import Arena, Bounds, Obstacles, Shape
from airl_mav.camera.frame import Frame
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.camera.render import expose
from airl_mav.core.errors import FieldError
from airl_mav.prediction import Reprojector
from airl_mav.profiles.camera import Camera
from airl_mav.profiles.vehicle import load_vehicle

data = load_vehicle("quad").camera.model_dump() | {"projection": "stereographic"}
data |= {"horizontal_fov_deg": 190.0, "width_px": 64, "height_px": 48, "stereo": None}
camera = Camera.model_validate(data)
k = Intrinsics.of(camera)
ball = Obstacles(
    np.array([Shape.SPHERE], np.int8), np.array([[6.0, 3.0, -4.0]]), np.ones((1, 3)), np.zeros(1)
)
arena = Arena("t", 0, Bounds(-20, 20, -20, 20, 9), (0, 0, 0), ball, (), np.zeros(2))
level = np.array([1.0, 0.0, 0.0, 0.0])
image = expose(arena, ball.center, k, 40.0, np.array([0.0, 0.0, -3.0]), level)
points = k.rays * (image / 1000.0)
camera_from_ball = np.array([0.0, 0.0, -3.0]) - ball.center[0]
surface = np.linalg.norm(points + camera_from_ball[:, None, None], axis=0)
column, row = k.model.places(k, np.array([6.0, 3.0, -1.0]))
wire = Frame(3, 5, image, k).to_bytes()
back = Frame.from_bytes(wire)
flow = k.model.flow(k, k.rays, np.zeros((3, 48, 64)))
try:
    Camera.model_validate(data | {"horizontal_fov_deg": 201.0})
    refused = ""
except FieldError as error:
    refused = error.accepted
print(json.dumps({
    "fov": np.degrees(k.horizontal_fov_rad),
    "ball": float(surface[round(float(row)), round(float(column))]),
    "floor": float(points[2].max()),
    "seen": float((image > 0).mean()),
    "magic": wire[:4].decode(),
    "same": bool((back.image == image).all() and back.intrinsics == k),
    "flow": float(np.abs(flow).max()),
    "refused": refused,
    "compensates": bool(Reprojector(camera, k)._sees.all()),
}))
"""


def test_a_projection_is_added_in_one_file_and_seen_through(tmp_path: Path) -> None:
    changed = tmp_path / "profiles"
    shutil.copytree(PROFILES, changed, ignore=shutil.ignore_patterns("__pycache__"))
    text = (PROFILES / "projections.py").read_text()
    assert text.count(LAST_LINE) == text.count(TABLE) == 1
    text = text.replace(LAST_LINE, LAST_LINE + LINE).replace(TABLE, CLASS + TABLE)
    (changed / "projections.py").write_text(text)
    done = subprocess.run(
        [sys.executable, "-c", SEEN, str(changed)], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert abs(found["fov"] - 190.0) < 1e-9
    assert abs(found["ball"] - 1.0) < 0.002
    assert abs(found["floor"] - 3.0) < 0.002
    assert found["seen"] > 0.5
    assert (found["magic"], found["same"], found["flow"]) == ("ADS1", True, 0.0)
    assert "value <= 200 deg with 'stereographic'" in found["refused"]
    assert found["compensates"]
