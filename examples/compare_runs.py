"""Compare two runs over pairs of flights: `static-obstacles` in calm air and in wind.

The vectorized simulator flies them in seconds. `level="lockstep"` uses MAVLink and MAVSDK.
"""

from airl_mav import Scenario, rehearse
from airl_mav.profiles.vehicle import WindSettings
from airl_mav.report.comparison.show import compare_folders

calm = rehearse(Scenario(level="gym", episodes=20), out="runs/calm")
windy = rehearse(
    Scenario(level="gym", episodes=20, wind=WindSettings(east_m_s=4.0, gust_m_s=1.5)),
    out="runs/windy",
)

comparison, _ = compare_folders([calm.path, windy.path], ["calm", "windy"])
(contrast,) = comparison.contrasts
for name in "flight_time_s", "distance_m", "energy_j":
    change = getattr(contrast.paired, name).difference
    print(
        f"{name:13}  {change.value:+6.1f} %  [{change.low:+.1f}, {change.high:+.1f}]"
        f"  over {change.n} pairs"
    )
print("the whole page: airl report runs/calm runs/windy")
