"""Fly with the decision latencies (t2) of a computer, from a file with one latency [ms] a line."""

from pathlib import Path

import numpy as np

from airl_mav import Scenario, rehearse

# Example data. Replace it by the latencies that you measured, in the order of the decisions.
latencies_ms = 120.0 + np.random.default_rng(1).gamma(2.0, 40.0, size=500)
file = Path("my-computer.txt")
file.write_text("".join(f"{each:.1f}\n" for each in latencies_ms), encoding="utf-8")

for latency in None, str(file):
    run = rehearse(Scenario(latency=latency, level="gym", episodes=20))
    t2_ms = run.latency["t2"] / 1000
    print(
        f"{latency or 'default'}: t2 {t2_ms.mean():.0f} ms, at most {t2_ms.max():.0f} ms; "
        f"success {run.quality.success_rate.value:.0%}, "
        f"flight time {run.quality.flight_time_s.value:.2f} s"
    )
