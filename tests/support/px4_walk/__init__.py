"""Calls of a MAVSDK program, with what a real PX4 1.16 SITL answers to them.

A row is a call and its expected outcome. `rows` has all of them; a service adds a module with rows
of its own there. `scripts/px4_walk.py` makes the calls at a running firmware, ours or a real PX4,
and prints both columns.
"""
