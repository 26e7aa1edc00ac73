"""Inputs, outputs and implementations of policies."""
