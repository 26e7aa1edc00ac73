"""Flights as they are flown, in a browser: what a flight tells, and the process that draws it."""
