"""The airframe as scalar numba kernels, one vehicle or N: rotors, body, power, battery."""
