"""`airl/Rehearsal-v0`: a rehearsal in lockstep with Gymnasium's API.

Each step is a decision of a flight through flight controller, MAVLink, MAVSDK and companion.
From Python: `gymnasium.make("airl_mav:airl/Rehearsal-v0")`, `rehearsal_env.gym_env.RehearsalEnv`.
Depends on: `airl_mav.lockstep`, `airl_mav.envs`; the extra `train`.
Guide: docs/how-to/gymnasium.md.
"""

ENVIRONMENTS = {"airl/Rehearsal-v0": "airl_mav.addons.rehearsal_env.gym_env:RehearsalEnv"}
