"""Faults of a flight: what can fail, how it is written down, and when it acts."""
