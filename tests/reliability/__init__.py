"""Promises about bad input, surroundings, files and killed processes, and their tests."""
