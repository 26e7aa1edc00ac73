"""The black box of a flight: an MCAP file that the companion writes while it flies."""
