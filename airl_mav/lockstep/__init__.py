"""Lockstep: plant, flight controller and companion on one simulated clock, MAVSDK in between."""
