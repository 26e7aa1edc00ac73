"""Depth of an arena from a pose, and the wire format of a frame."""
