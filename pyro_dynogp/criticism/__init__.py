"""Criticism of fits: ArviZ, predictive densities of left-out data, calibration, verdicts."""
