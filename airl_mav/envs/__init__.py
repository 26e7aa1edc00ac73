"""Training environments: N vehicles at a time on the same kernels as the rehearsal."""
