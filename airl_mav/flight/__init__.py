"""Flights: trajectories, verdicts and quality."""
