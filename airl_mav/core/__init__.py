"""Basics for every package: time, units, frames, files, errors, the machine."""
