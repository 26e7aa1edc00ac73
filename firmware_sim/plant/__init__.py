"""The vehicle, its sensors and its camera in the arena."""
