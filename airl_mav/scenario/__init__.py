"""Scenario: configuration of a rehearsal, its file format, and its resolution."""
