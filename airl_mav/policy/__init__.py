"""What a policy sees and does: observations, actions, policies."""
