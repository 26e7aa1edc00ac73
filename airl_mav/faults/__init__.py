"""Faults of a flight: catalogue, text format and schedule."""
