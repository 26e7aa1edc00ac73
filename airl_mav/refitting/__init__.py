"""Vehicle and computer profiles from what a flight has recorded."""
