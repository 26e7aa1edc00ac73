"""Aircraft side of the MAVLink link: plant, autopilot and MAVLink services."""
