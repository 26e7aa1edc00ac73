"""Profiling: this computer's decision latency for a policy, as a computer profile."""
