"""PX4's multicopter cascade as numba kernels: velocity -> attitude -> rate -> mixer."""
