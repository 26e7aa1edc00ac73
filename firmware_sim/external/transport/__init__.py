"""Transports to external firmware: serial port, and the router between a board and UDP."""
