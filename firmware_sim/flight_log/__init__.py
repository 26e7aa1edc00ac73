"""Flight log of the vehicle: ULog (.ulg), PX4's log format."""
