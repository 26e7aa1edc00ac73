"""Replay of a recorded run in the scene of the live view."""
