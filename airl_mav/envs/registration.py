"""Importing this registers `airl/Navigation-v0` with Gymnasium.

`gymnasium.make("airl_mav.envs.registration:airl/Navigation-v0", arena="dense-obstacles")` does both
at once. `gymnasium.make_vec` gives n at a time on the compiled kernels. Keyword arguments are the
fields of `airl_mav.envs.spec.EnvironmentSpec`, its tables as dicts. (Gymnasium has had no plugins
that register themselves since 1.0.)
"""

from __future__ import annotations

import gymnasium as gym

NAVIGATION = "airl/Navigation-v0"

if NAVIGATION not in gym.registry:
    gym.register(
        id=NAVIGATION,
        entry_point="airl_mav.envs.single:NavigationEnv",
        vector_entry_point="airl_mav.envs.vector:NavigationVectorEnv",
    )
