"""MAVLink events, as PX4 sends them: numbers that ground stations have words for."""
