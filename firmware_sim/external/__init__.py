"""Real firmware in place of the built-in autopilot: one bridge for each simulator interface."""
