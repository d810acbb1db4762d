"""Logged columns: their roles, how they are shown, and what is wrong with their logging."""
