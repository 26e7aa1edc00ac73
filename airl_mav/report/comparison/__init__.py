"""Any number of runs compared: one model, its tables and figures, and the kinds of comparison."""
