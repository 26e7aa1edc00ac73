"""Sensor ablation: policies with one input made zero, in the body layout and in the paper's own.

    python scripts/studies/ablation.py [--quick] [--episodes N] [--out DIR] [--config FILE]

The policies of the paper's layout are trained first, about two minutes each on one core: needs the
train extra.
"""

from airl_mav.studies.ablation import ABLATION_STUDY
from airl_mav.studies.study import main

if __name__ == "__main__":
    main(ABLATION_STUDY, __file__)
