"""The architecture search: many trainings of template networks, and what came out of them."""
