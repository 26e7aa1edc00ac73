"""Calls of a MAVSDK program, with the answers of a real PX4 1.16 SITL.

A row is a call and its expected outcome. `rows` has all of them; a new service adds a module with
rows there. `scripts/px4_walk.py` makes the calls at a running firmware, ours or a real PX4, and
prints both columns.
"""
