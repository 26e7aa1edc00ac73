"""What a decision will act on: the vehicle's state and its camera's image, carried forward."""
