"""Live view of flights in a browser: messages from a flight and the process that draws them."""
