"""Failsafes: automatic responses to failures, as in PX4.

`failsafe_conditions` lists the failures, `failsafe_table` their actions, `framework` selects and
times the active action, and `watch` detects the conditions.
"""
