"""Models as Pyro functions, and the priors they are made of."""
