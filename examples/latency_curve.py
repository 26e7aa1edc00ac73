"""The latency curve of a policy: the same seeds at growing latencies, in the batch twin."""

from airl_mav import Scenario, rehearse

EPISODES = 20

print("latency   success   flight time   distance")
for latency in "1ms", "200ms", "400ms":
    run = rehearse(Scenario(level="gym", episodes=EPISODES, latency=latency))
    quality = run.quality
    print(
        f"{latency:>7}   {quality.success_rate.value:7.0%}   "
        f"{quality.flight_time_s.value:9.2f} s   {quality.distance_m.value:6.2f} m"
    )
