"""Reports of a run: terminal tables, a self-contained HTML page, PNG pictures."""
