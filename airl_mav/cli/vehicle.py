"""Load a vehicle for a command: the profile, and its parameters against the flight controller's."""

from __future__ import annotations

from airl_mav.errors import UsageError
from airl_mav.profiles.loading import load_profile
from airl_mav.profiles.vehicle import VehicleProfile
from firmware_sim.autopilot.parameters import Parameters


def load_vehicle(name: str) -> VehicleProfile:
    """Return a vehicle profile by name or path.

    Raises:
        UsageError: The profile cannot be used, or sets a parameter that the flight controller
            does not know or accept.
    """
    vehicle = load_profile("vehicles", name, VehicleProfile)
    try:
        Parameters(vehicle.parameters)
    except UsageError as error:
        raise UsageError(f"vehicle {name}: {error}") from None
    return vehicle
