"""Checks of an answer, and everything that is reported besides its findings."""
