"""Fly a program of your own in lockstep: real MAVSDK, simulated time, the same flight every time.

Simulated time stands still while the program computes and moves only while it sleeps by
`stage.clock`. Run it twice: both runs print the same position, to the last digit.
"""

from airl_mav.lockstep.stage import LockstepStage
from airl_mav.profiles.vehicle import load_vehicle
from companion.link_interface import BodyVelocity
from firmware_sim.simulation import EpisodeSetup

with LockstepStage() as stage:

    def program() -> None:
        """Take off, fly forward for five seconds, land."""
        stage.link.arm(20.0, stage.abandon)
        stage.link.takeoff(2.5, 30.0, stage.abandon)
        stage.link.enter_offboard()
        stage.link.send_setpoint(BodyVelocity(2.0, 0.0, 0.0, 0.0))
        stage.clock.sleep_until(stage.clock.time_us() + 5_000_000)
        stage.link.land(60.0)

    simulation = stage.run(EpisodeSetup(load_vehicle("quad"), arena=None, seed=1), program)
    print(simulation.truth.position)  # north, east, down [m]
