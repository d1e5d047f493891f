"""Trajectories of stochastic LTI systems as Pyro distributions."""

# Divergences are registered with torch when their modules are read.
from pyro_dynogp.distributions import divergence as divergence
