"""Latency sweep of a policy: the same seeds at increasing latencies, at level gym."""

from airl_mav import Scenario, latency_sweep

asked = Scenario(policy="static-obstacles-fast", level="gym", episodes=50)
curve = latency_sweep(asked, latencies=("native", "200ms", "400ms"))

print("latency   success   flight time   distance")
for run in curve.comparison.runs:
    quality = run.quality
    print(
        f"{run.label:>7}   {quality.success_rate.value:7.0%}   "
        f"{quality.flight_time_s.value:9.2f} s   {quality.distance_m.value:6.2f} m"
    )
for contrast in curve.comparison.contrasts:
    change = contrast.paired.flight_time_s.difference
    print(
        f"{contrast.entry.title}: {change.value:+.1f} % of flight time "
        f"[{change.low:+.1f}, {change.high:+.1f}] over {change.n} pairs"
    )
print(f"report: {curve.page}")
