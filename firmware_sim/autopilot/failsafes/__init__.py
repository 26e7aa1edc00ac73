"""Failsafes: automatic responses to failures, as in PX4.

`conditions` lists the failures, `table` their actions, `framework` selects and times the active
action, and `watch` detects the conditions.
"""
