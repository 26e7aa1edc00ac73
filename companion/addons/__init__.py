"""Add-ons of the companion; `airl_mav/core/addons.py` finds them."""
