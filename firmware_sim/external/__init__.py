"""Real firmware in place of the built-in autopilot: one bridge per simulator interface."""
