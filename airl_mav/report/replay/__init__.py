"""A run that was flown, in the scene of the live view."""
