"""Causes of failed and long flights, derived from recorded data."""
