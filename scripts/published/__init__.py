"""Published results: figures with their provenance (docs/how-to/results.md)."""
