"""What a rehearsal is asked for: the one model of it, its file, and its resolution."""
