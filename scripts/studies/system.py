"""System evaluation: each arena's policy on a workstation and on the onboard computer.

    python scripts/studies/system.py [--quick] [--episodes N] [--out DIR] [--config FILE]

The paper's three tables of system evaluation, and its trajectories with a fixed goal.
"""

from airl_mav.studies.study import main
from airl_mav.studies.system import SYSTEM_STUDY

if __name__ == "__main__":
    main(SYSTEM_STUDY, __file__)
