"""The studies of the Air Learning paper: campaigns of evaluations, each with a page of answers."""
