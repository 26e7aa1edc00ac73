"""Flights of a run as logs that others read: MCAP for Foxglove and rerun, ULog for PX4's tools."""
