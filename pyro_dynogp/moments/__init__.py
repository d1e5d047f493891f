"""Moment-matching (assumed-density) filter of a cascade of linear and static layers, compiled."""

from pathlib import Path

from pyro_dynogp.support.compiled import drop_stale

_HERE = Path(__file__).parent
drop_stale(_HERE, _HERE.parent / "lti")
