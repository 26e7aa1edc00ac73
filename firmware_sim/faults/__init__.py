"""Faults at work: between plant and flight controller, on the camera and on the links."""
