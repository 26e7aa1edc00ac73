"""Typed profiles: what flies (vehicle), what decides (computer), where (arena).

TOML files in `profiles/`, shipped with the package. Every number has a unit and a range. Load one
with `airl_mav.profiles.loading.load_profile`.
"""
