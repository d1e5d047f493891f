"""Fitting: starts, posterior mode, variational inference, NUTS, and the frozen result."""
