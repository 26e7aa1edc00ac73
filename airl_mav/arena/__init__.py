"""Environment generator: (spec, seed) -> a concrete arena with walls, obstacles and a goal."""
