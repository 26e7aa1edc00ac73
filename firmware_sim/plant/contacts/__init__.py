"""What the vehicle's box touches, and what comes of it: the kernel plant's contacts."""
