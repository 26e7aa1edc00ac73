"""The same flight healthy, with a jump of the GPS position, without GPS, and with late GPS."""

from airl_mav import Scenario, rehearse

FAULTS = (
    "gps bias 20,0,0m at offboard+1s for 5s",
    "gps off at offboard+1s",
    "gps delay 800ms at offboard",
)

for faults in [], *([fault] for fault in FAULTS):
    asked = {"level": "lockstep", "episodes": 1, "faults": faults}
    (flight,) = rehearse(Scenario.model_validate(asked)).episodes
    assert flight.quality is not None
    print(f"{', '.join(faults) or 'healthy'}: {flight.outcome.value}, {flight.reason}")
    print(f"  {flight.quality.flight_time_s:.1f} s, {flight.quality.distance_m:.1f} m")
    for fault in flight.faults:
        print(f"  {fault.fault}: {(fault.to_us - fault.from_us) / 1e6:.2f} s")
