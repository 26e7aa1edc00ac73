"""Prediction: the vehicle's state and camera image at the time when a decision takes effect."""
