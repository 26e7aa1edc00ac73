"""Colour images a second where every obstacle is varnish, metal or glass, on one core.

Run as `python benchmarks/bench_gloss.py`. Dense Obstacles of seed 3, images of 64 x 48 pixels from
200 places, by the function that the rehearsal's camera calls.
"""

from __future__ import annotations

import math
import time

import numpy as np

from airl_mav.addons.colour.picture import render_picture
from airl_mav.addons.colour.profile import Appearance
from airl_mav.arena.generate import generate
from airl_mav.camera.intrinsics import Intrinsics
from airl_mav.core.frames import quat_from_euler
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile

CAMERA = Intrinsics.from_fov(64, 48, 1.5)
PLACES, ROUNDS = 200, 5
MIXED = ("mirror", "glass", "lacquer", "brushed-steel", "brick")


def rate(materials: tuple[str, ...]) -> tuple[float, int]:
    """Return images a second, the best of rounds, and the number of obstacles."""
    spec = load_profile("arenas", "dense-obstacles", ArenaSpec)
    look = Appearance.model_validate({"static": {"materials": materials}})
    spec = spec.model_copy(update={"appearance": look})
    arena = generate(spec, 3, name="dense-obstacles", vehicle_width_m=0.55)
    centers, rng, best = arena.centers_at(0), np.random.default_rng(0), math.inf
    poses = [
        (
            np.array((rng.uniform(0, 40), rng.uniform(-20, 20), -3.0)),
            quat_from_euler(0.0, 0.0, rng.uniform(-math.pi, math.pi)),
        )
        for _ in range(PLACES)
    ]
    render_picture(arena, centers, CAMERA, *poses[0])  # compiles
    for _ in range(ROUNDS):
        start = time.perf_counter()
        for position, attitude in poses:
            render_picture(arena, centers, CAMERA, position, attitude)
        best = min(best, time.perf_counter() - start)
    return PLACES / best, len(arena.obstacles)


def main() -> None:
    for materials in (("brick",), *((name,) for name in MIXED[:-1]), MIXED):
        images, obstacles = rate(materials)
        print(f"{', '.join(materials):<50} {images:8,.0f} images/s, {obstacles} obstacles")


if __name__ == "__main__":
    main()
