"""The same flight with a healthy camera, with a frozen one, and on a link that loses frames."""

from airl_mav import Scenario, rehearse

for faults in ([], ["camera stuck at offboard+500ms for 500ms"], ["uplink loss 30% at offboard"]):
    asked = {"level": "lockstep", "episodes": 1, "seed": 11, "faults": faults}
    (flight,) = rehearse(Scenario.model_validate(asked)).episodes
    print(f"{', '.join(faults) or 'healthy'}: {flight.outcome.value}, {flight.reason}")
    for fault in flight.faults:
        print(f"  {fault.fault}: {(fault.to_us - fault.from_us) / 1e6:.2f} s")
