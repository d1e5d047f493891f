"""Simulation, k-step prediction, forecast, and scores."""
