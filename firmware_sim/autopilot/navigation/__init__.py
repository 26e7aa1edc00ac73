"""Navigation as in PX4's navigator: geofence, destination of Return, and stored plans."""
