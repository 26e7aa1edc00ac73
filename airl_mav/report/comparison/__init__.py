"""Comparison of any number of runs: common model, tables, figures, and kinds of comparison."""
