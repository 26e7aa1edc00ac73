"""Typed profiles of vehicles, computers, arenas, training runs and more.

TOML files in `profiles/`, shipped with the package. Every number has a unit and a range. Load one
with `airl_mav.profiles.loading.load_profile`.
"""
