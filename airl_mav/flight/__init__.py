"""Flights: what was flown, how it ended, how well it went."""
