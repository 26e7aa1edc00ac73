"""Export of a run's flights: MCAP for Foxglove and rerun, ULog for PX4's tools."""
