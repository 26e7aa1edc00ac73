"""Navigation as in PX4's navigator: missions, geofence and rally points."""
