"""Commands of the `airl` programs, one module per command."""
