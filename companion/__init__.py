"""Companion software on the drone: link, camera, pilot and watchdog."""
