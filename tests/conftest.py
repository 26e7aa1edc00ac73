"""Settings of all tests."""

from __future__ import annotations

from hypothesis import settings

# The first call of a kernel on a fresh machine compiles it: seconds, not a slow example.
settings.register_profile("kernels", deadline=None)
settings.register_profile("thorough", deadline=None, max_examples=3000)
settings.load_profile("kernels")
