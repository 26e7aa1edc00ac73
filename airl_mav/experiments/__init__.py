"""Experiments: many flights or trainings, spread over workers, kept in one resumable folder."""
