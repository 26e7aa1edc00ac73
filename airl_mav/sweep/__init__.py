"""Architecture search: many trainings of template networks, and their results."""
