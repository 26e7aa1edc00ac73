"""Everything on the aircraft side of the MAVLink link: plant, autopilot, MAVLink services."""
