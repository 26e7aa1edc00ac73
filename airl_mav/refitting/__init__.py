"""Refit: vehicle and computer profiles estimated from a recorded flight."""
