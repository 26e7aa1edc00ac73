"""Runs: the processes of a rehearsal, the order they start in, and what they leave behind."""
