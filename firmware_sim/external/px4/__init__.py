"""PX4 as the flight controller: SITL over TCP, HITL over a serial line."""
