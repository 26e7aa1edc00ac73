"""The shared vocabulary of a rehearsal: what a flight is, what a policy sees, how it is judged."""

__version__ = "0.1.0"
