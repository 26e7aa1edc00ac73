"""Fault injection between plant and flight controller, in the camera and on the links."""
