"""Static Gaussian-process layers and their kernels as Pyro sample sites."""
