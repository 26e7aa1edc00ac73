"""Vehicle, sensors and camera in the arena."""
