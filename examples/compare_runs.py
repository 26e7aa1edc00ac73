"""Compare two policies on the same seeds: differences over pairs of flights.

The vectorized simulator flies them in seconds. `level="lockstep"` uses MAVLink and MAVSDK.
"""

from airl_mav import Scenario, rehearse
from airl_mav.report.comparison.show import compare_folders

policies = ["static-obstacles", "static-obstacles-fast"]
folders = [
    rehearse(Scenario(policy=policy, level="gym", episodes=20), out=f"runs/{policy}").path
    for policy in policies
]

comparison, _ = compare_folders(folders, policies)
(contrast,) = comparison.contrasts
for name in "flight_time_s", "distance_m", "energy_j":
    change = getattr(contrast.paired, name).difference
    print(
        f"{name:13}  {change.value:+6.1f} %  [{change.low:+.1f}, {change.high:+.1f}]"
        f"  over {change.n} pairs"
    )
print(f"the whole page: airl report {' '.join(f'runs/{policy}' for policy in policies)}")
