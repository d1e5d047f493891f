"""Data sets that ship, and simulated systems."""
