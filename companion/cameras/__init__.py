"""Depth cameras on the aircraft: what a driver is, how its images become frames, and drivers."""
