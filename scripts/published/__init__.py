"""Published results: figures with what made them (docs/how-to/results.md)."""
