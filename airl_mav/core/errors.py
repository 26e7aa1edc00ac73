"""Errors meant for the person at the keyboard: one line, exit code 2, no traceback."""

from __future__ import annotations


class UsageError(Exception):
    """Input that cannot be used. The message names the file, field, value and accepted range."""
