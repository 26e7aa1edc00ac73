"""One vehicle as two records, and the compiled ticks that advance them."""
