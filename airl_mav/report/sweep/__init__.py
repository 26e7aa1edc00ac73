"""The architecture search: tabled, drawn."""
