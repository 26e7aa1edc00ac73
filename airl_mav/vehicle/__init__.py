"""Airframe as scalar numba kernels, for one vehicle or N: rotors, body, power, battery."""
