"""Mitigation: the hardware gap with and without it, and flights to one goal.

    python scripts/studies/mitigation.py [--quick] [--episodes N] [--out DIR] [--config FILE]

The paper's table of mitigation (`airl gap` with the configuration's settings) and its trajectories.
"""

from airl_mav.studies.mitigation import MITIGATION_STUDY
from airl_mav.studies.study import main

if __name__ == "__main__":
    main(MITIGATION_STUDY, __file__)
