"""Static Gaussian-process layers and their kernels as Pyro sample sites."""

from pathlib import Path

from pyro_dynogp.support.compiled import drop_stale

_HERE = Path(__file__).parent
drop_stale(_HERE, _HERE.parent / "lti")
