"""Compile every kernel of plant and vectorized simulator, before many processes need them.

numba's cache is shared, but has no lock: processes that start together compile the same code each.
`compile_kernels.py plant` and `compile_kernels.py gym` share little, and may run side by side.
"""

import sys
from typing import get_args

import numpy as np

from airl_mav.envs.evaluation import fly_episodes
from airl_mav.envs.spec import EnvironmentSpec
from airl_mav.profiles.projections import KINDS
from airl_mav.profiles.vehicle import load_vehicle
from airl_mav.scenario.aircraft import HAS_PYBULLET, PlantName
from firmware_sim.warm_up import warm_up


def compile_plant() -> None:
    """Compile the kernels of flight controller and plant."""
    for plant in get_args(PlantName):
        if plant == "kernel" or HAS_PYBULLET:
            warm_up(load_vehicle("quad"), plant)


def compile_gym() -> None:
    """Compile the kernels of the vectorized simulator and its cameras."""
    for kind in KINDS:
        short = {"episode": {"time_limit_s": 1.0}, "camera": {"kind": kind}}
        spec = EnvironmentSpec.model_validate(short)
        for _ in fly_episodes(spec, lambda seen: np.zeros(len(seen["goal"]), np.int64), [1]):
            pass


PARTS = {"plant": compile_plant, "gym": compile_gym}

if __name__ == "__main__":
    for part in sys.argv[1:] or PARTS:
        PARTS[part]()
