"""Mathematics of stochastic linear time-invariant systems: tensors in, tensors out, no Pyro."""
