"""Generalisation: every policy in every arena.

python scripts/studies/generalisation.py [--quick] [--episodes N] [--out DIR] [--config FILE]
"""

from airl_mav.studies.generalisation import GENERALISATION_STUDY
from airl_mav.studies.study import main

if __name__ == "__main__":
    main(GENERALISATION_STUDY, __file__)
