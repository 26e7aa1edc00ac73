"""Registers `airl/Navigation-v0` with Gymnasium.

`import airl_mav` imports this module as soon as Gymnasium is imported, so
`gymnasium.make("airl_mav:airl/Navigation-v0", arena="dense-obstacles")` needs no other import.
`gymnasium.make_vec` creates n environments on the compiled kernels. Keyword arguments are fields of
`airl_mav.envs.spec.EnvironmentSpec`, its tables as dicts; without an image size, the network
receives the camera's native size. (Gymnasium dropped self-registering plugins in 1.0.)
"""

from __future__ import annotations

import gymnasium as gym

NAVIGATION = "airl/Navigation-v0"
REHEARSAL = "airl/Rehearsal-v0"

if NAVIGATION not in gym.registry:
    gym.register(
        id=NAVIGATION,
        entry_point="airl_mav.envs.navigation_env:NavigationEnv",
        vector_entry_point="airl_mav.envs.vector:NavigationVectorEnv",
    )

if REHEARSAL not in gym.registry:
    gym.register(id=REHEARSAL, entry_point="airl_mav.lockstep.gym_env:RehearsalEnv")
