"""Degradation: a policy as its decisions come later and later, on the same seeds.

    python scripts/studies/degradation.py [--quick] [--episodes N] [--out DIR] [--config FILE]

The paper's table of degradation (base, 150, 300 ms; here 400 and 950 ms too) and its trajectories
with a fixed goal.
"""

from airl_mav.studies.degradation import DEGRADATION_STUDY
from airl_mav.studies.study import main

if __name__ == "__main__":
    main(DEGRADATION_STUDY, __file__)
