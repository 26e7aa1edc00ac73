"""The paper's power model of a 3DR Solo."""

from __future__ import annotations

from airl_mav.profiles.vehicle import Regression

SOLO = Regression(
    model="regression",
    b1_vxy=-1.526,
    b2_axy=3.934,
    b3_vxy_axy=0.968,
    b4_vz=18.125,
    b5_az=96.613,
    b6_vz_az=-1.085,
    b7_payload=0.220,
    b8_wind=1.332,
    b9_hover=433.9,
)
"""3DR Solo, arXiv 1703.10049 as quoted by Krishnan et al. 2021, eq. 1."""
