"""Nothing is compiled, or loaded, in flight: a tick has 4 ms."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.processes import run_alone

PROGRAM = """
import gc
from numba.core.dispatcher import Dispatcher
from firmware_sim.autopilot.flight_modes import Mode
from airl_mav.profiles.vehicle import load_vehicle
from firmware_sim.warm_up import warm_up
from tests.support.flight_rig import flight, velocity_setpoint

def compiled():
    kernels = (each for each in gc.get_objects() if isinstance(each, Dispatcher))
    return {(each.__module__, each.__name__): len(each.signatures) for each in kernels}

vehicle = load_vehicle("VEHICLE")
warm_up(vehicle)
before = compiled()
with flight(1, vehicle=vehicle) as rig:
    if vehicle.told_origin is not None:
        rig.ap.set_origin(vehicle.told_origin)
    rig.run(5.0)
    rig.sim.capture_due(rig.sim.time_us, lambda frame: None)
    rig.take_off(2.5)
    rig.go_offboard(velocity_setpoint(2.0, 0.0, 0.0))
    rig.run(2.0)
    rig.ap.set_mode(Mode.LAND)
    rig.run(6.0)
after = compiled()
assert len(after) > 20, after
new = {name: count for name, count in after.items() if before.get(name) != count}
assert not new, new
"""


# quad-indoor includes everything of quad-vio.
@pytest.mark.parametrize(
    "vehicle",
    [
        "quad",
        pytest.param("quad-rgb", marks=pytest.mark.nightly),
        pytest.param("quad-indoor", marks=pytest.mark.nightly),
        pytest.param("quad-flow", marks=pytest.mark.nightly),
        pytest.param("quad-vio", marks=pytest.mark.nightly),
    ],
)
def test_a_flight_asks_for_no_kernel_that_was_not_there_before(
    vehicle: str, tmp_path: Path
) -> None:
    done = run_alone(PROGRAM.replace("VEHICLE", vehicle), tmp_path)
    assert done.returncode == 0, done.stderr
