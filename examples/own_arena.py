"""An arena of your own: write its file, look at it, fly in it.

The generator is a pure function of the file and a seed.
"""

from pathlib import Path

from airl_mav import Scenario, rehearse
from airl_mav.arena.draw import save_png
from airl_mav.arena.generate import generate
from airl_mav.profiles.arena import ArenaSpec
from airl_mav.profiles.loading import load_profile

FOREST = """
description = "20 to 30 thin trunks in 40 x 40 m"
min_clearance_m = 1.5

[size]
north_m = 40.0
east_m = 40.0
height_m = 6.0

[start]
north_m = 3.0
east_m = 20.0

[goal]
min_distance_m = 10.0

[static]
count = [20, 30]
shapes = ["cylinder"]
half_width_m = [0.15, 0.4]
height_m = [5.0, 6.0]
"""

file = Path("forest.toml")
file.write_text(FOREST, encoding="utf-8")

arena = generate(
    load_profile("arenas", str(file), ArenaSpec), 7, name="forest", vehicle_width_m=0.55
)
save_png(arena, Path("forest.png"))
print(
    f"seed 7: {arena.n_static} trunks, goal {arena.goal[0]:.1f} m north, {arena.goal[1]:.1f} m east"
)

run = rehearse(Scenario(arena=str(file), level="gym", episodes=2, seed=7))
for episode in run.episodes:
    print(f"seed {episode.seed}: {episode.outcome.value}, {episode.reason}")
