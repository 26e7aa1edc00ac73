"""Failsafes: automatic responses to failures, as in PX4.

`failsafe_conditions` lists failures and actions, `failsafe_table` relates them, `framework` selects
and times the active action, and `watch` detects the conditions.
"""
