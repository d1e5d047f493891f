"""Stored results of fits, leave-one-out and closed loops, for comparison with later versions."""
