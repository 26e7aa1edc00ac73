"""MAVLink events as sent by PX4: ids with texts in ground stations."""
