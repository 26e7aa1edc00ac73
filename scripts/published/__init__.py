"""Published results: figures with their provenance (docs/contributing/results.md)."""
