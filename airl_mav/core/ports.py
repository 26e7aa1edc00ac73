"""The address that everything binds unless the user asks otherwise."""

LOOPBACK = "127.0.0.1"
