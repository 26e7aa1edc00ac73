"""What a run is shown as: terminal tables, a self-contained HTML page, PNG pictures."""
