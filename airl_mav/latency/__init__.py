"""Decision latency: stamps, stages, percentiles, and injection."""
