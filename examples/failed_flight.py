"""Print the cause of every failed flight of a run, at the latency of a Raspberry Pi 4."""

from airl_mav import Scenario, rehearse
from airl_mav.addons.forensics.worst import examine_worst
from airl_mav.flight.judge import Outcome
from airl_mav.rehearsal.run_folder import arenas_of, load, vehicle_of

slow = Scenario(
    policy="static-obstacles-fast",
    latency="lognormal:396ms,20ms",
    level="gym",
    episodes=40,
)
run = load(rehearse(slow, out="runs/pi").path)

vehicle = vehicle_of(run.info)
for flight in examine_worst(run, arenas_of(run.episodes, vehicle), vehicle):
    if flight.record.outcome is not Outcome.SUCCESS:
        print(f"flight {flight.record.index}, {flight.record.reason}: {flight.cause.kind}")
        print(f"  {' '.join(flight.cause.sentences)}")
print("all flights: airl report runs/pi")
