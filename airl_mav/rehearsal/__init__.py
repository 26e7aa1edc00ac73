"""Runs: processes of a rehearsal, their start order and their output files."""
