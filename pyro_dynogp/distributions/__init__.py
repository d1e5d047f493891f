"""Trajectories of stochastic LTI systems as Pyro distributions."""
