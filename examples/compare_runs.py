"""Compare two runs in pairs: the default policy in calm air and in wind, the same seeds."""

import numpy as np

from airl_mav import Scenario, rehearse
from airl_mav.scenario.model import WindSettings

calm = rehearse(Scenario(level="lockstep", episodes=3), out="runs/calm")
windy = rehearse(
    Scenario(level="lockstep", episodes=3, wind=WindSettings(east_m_s=4.0, gust_m_s=1.5)),
    out="runs/windy",
)

reached = [
    (one.quality, other.quality)
    for one, other in zip(calm.episodes, windy.episodes, strict=True)
    if one.outcome.value == other.outcome.value == "success"
]
change = np.array([b.flight_time_s / a.flight_time_s - 1 for a, b in reached])
print(f"{len(reached)} pairs: the wind costs {change.mean():+.1%} of flight time")
print("all figures with intervals: airl report runs/calm runs/windy")
