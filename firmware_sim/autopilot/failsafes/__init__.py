"""Failsafes: what the autopilot does by itself when something fails, as PX4 does it.

`conditions` is what may fail, `table` which action follows, `framework` which of several actions
flies and when, `watch` where the conditions come from.
"""
