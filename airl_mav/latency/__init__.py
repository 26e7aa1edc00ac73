"""How late a decision is: stamps, stages, percentiles, and latencies to inject."""
