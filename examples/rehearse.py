"""Rehearse `static-obstacles` as late as a Raspberry Pi 4, from Python."""

from airl_mav import Scenario, rehearse

run = rehearse(
    Scenario(
        policy="static-obstacles",
        computer="ras-pi-4",
        workload="template-5x32",
        level="lockstep",
        episodes=2,
    )
)
for episode in run.episodes:
    print(f"seed {episode.seed}: {episode.outcome.value}, {episode.reason}")
print(f"t2: {run.latency['t2'].mean() / 1000:.0f} ms over {len(run.latency['t2'])} decisions")
print(f"digest of all flights: {run.sha256}")
print(f"report: {run.report()}")
