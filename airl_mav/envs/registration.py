"""Registers `airl/Navigation-v0` with Gymnasium.

`import airl_mav` sees to it that this is imported once Gymnasium is, so that
`gymnasium.make("airl_mav:airl/Navigation-v0", arena="dense-obstacles")` needs no other import.
`gymnasium.make_vec` gives n at a time on the compiled kernels. Keyword arguments are the fields of
`airl_mav.envs.spec.EnvironmentSpec`, its tables as dicts; where neither size of the image is given,
the network sees the camera's own. (Gymnasium has had no plugins that register themselves since
1.0.)
"""

from __future__ import annotations

import gymnasium as gym

NAVIGATION = "airl/Navigation-v0"
REHEARSAL = "airl/Rehearsal-v0"

if NAVIGATION not in gym.registry:
    gym.register(
        id=NAVIGATION,
        entry_point="airl_mav.envs.single:NavigationEnv",
        vector_entry_point="airl_mav.envs.vector:NavigationVectorEnv",
    )

if REHEARSAL not in gym.registry:
    gym.register(id=REHEARSAL, entry_point="airl_mav.lockstep.gym_env:RehearsalEnv")
