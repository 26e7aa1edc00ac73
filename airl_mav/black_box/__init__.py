"""Black box of a flight: an MCAP file written by the companion in flight."""
