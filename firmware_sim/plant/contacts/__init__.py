"""Contacts of the vehicle's box in the kernel plant."""
