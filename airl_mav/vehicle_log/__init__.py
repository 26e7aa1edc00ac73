"""Flight controller's log (PX4's .ulg) and its alignment with a companion's recording."""
