"""Depth cameras on the aircraft: interface of drivers, conversion into frames, and drivers."""
