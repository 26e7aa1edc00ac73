"""Add-ons of the flight controller; `airl_mav/core/addons.py` finds them."""
