"""Default address for all sockets."""

LOOPBACK = "127.0.0.1"
