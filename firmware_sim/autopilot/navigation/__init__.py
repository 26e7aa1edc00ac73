"""Where the vehicle shall go: missions, the geofence and rally points, as PX4's navigator."""
