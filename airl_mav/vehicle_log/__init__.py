"""The flight controller's own log (PX4's .ulg) beside a companion's recording."""
