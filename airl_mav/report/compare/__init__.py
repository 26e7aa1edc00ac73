"""Any number of runs beside each other: worked out, tabled, drawn."""
