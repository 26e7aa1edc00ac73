"""ArduPilot SITL as the flight controller, over its JSON interface."""
