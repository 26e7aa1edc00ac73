"""The hardware gap: worked out, tabled, drawn."""
