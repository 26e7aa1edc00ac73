"""Profiling: how long this computer takes for a policy's decisions, as a computer profile."""
