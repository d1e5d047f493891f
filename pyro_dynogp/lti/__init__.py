"""Mathematics of stochastic linear time-invariant systems: tensors in, tensors out, no Pyro."""

from pathlib import Path

from pyro_dynogp.support.compiled import drop_stale

drop_stale(Path(__file__).parent)
