"""The fidelity ladder: worked out, tabled, drawn."""
