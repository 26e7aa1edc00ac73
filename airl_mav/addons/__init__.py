"""Add-ons: see `airl_mav.core.addons`."""
