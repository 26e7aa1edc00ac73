"""State of one vehicle as records, and the compiled ticks that advance them."""
