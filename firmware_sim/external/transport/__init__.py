"""The lines to external firmware: TCP, serial, and the router between a board and UDP."""
