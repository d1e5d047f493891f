"""Minima near one whose derivatives are known."""

from __future__ import annotations

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Play
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.function_evidence import kernel_sites
from pyro_dynogp.inference.optimise.chord import along_chord
from pyro_dynogp.inference.optimise.gauss_newton import climb
from pyro_dynogp.inference.optimise.innovation_energy import Innovations, Local
from pyro_dynogp.models.variants import with_channel
from tests.inference.test_numbers_of_functions import WIDTH, sprung


@pytest.fixture(scope="module")
def at_minimum() -> tuple[Innovations, np.ndarray, Local]:
    """Of a spring with its kernels held: the minimum, and its derivatives."""
    record = sprung(0)
    model = with_channel(dgp.NonlinearFeedback(1, pairs=1), Play("u", WIDTH))
    fit = dgp.fit(model, record, method="map", workers=1, progress=False)
    collapsed = fit.model.collapsed
    potential = Potential(collapsed, (collapsed.prepare(record),), fit.mode)
    free = np.setdiff1d(np.arange(potential.size), potential.places(kernel_sites(collapsed)))
    innovations = Innovations(potential, free)
    z, _, _ = climb(innovations, potential.pack(fit.mode).numpy(), 300, ridge=1e-4)
    here = innovations.local(z)
    assert here is not None
    return innovations, z, here


def moved(innovations: Innovations, z: np.ndarray, size: float) -> np.ndarray:
    """The point with its free entries elsewhere."""
    out = z.copy()
    out[innovations.free] += size * np.random.default_rng(0).standard_normal(len(innovations.free))
    return out


def test_it_leads_to_the_minimum(at_minimum) -> None:
    innovations, z, here = at_minimum
    beside = moved(innovations, z, 1e-3)
    assert innovations.energies(beside[None])[0] > here.energy + 10.0
    energy, end, there = along_chord(innovations, here, beside, 8, 0.2)
    assert there
    assert energy == pytest.approx(here.energy, abs=0.25)  # 0.2 nats may be left
    # One point and several of them are added up in another order.
    assert energy == pytest.approx(innovations.energies(end[None])[0], rel=1e-12)
    held = np.setdiff1d(np.arange(len(z)), innovations.free)
    assert len(held)
    np.testing.assert_array_equal(end[held], z[held])


def test_what_is_not_reached_is_said(at_minimum) -> None:
    """Too few steps, and far away; what is returned is no higher than where it began."""
    innovations, z, here = at_minimum
    for steps, size in ((0, 3e-3), (1, 3e-3), (30, 3.0)):
        beside = moved(innovations, z, size)
        energy, end, there = along_chord(innovations, here, beside, steps, 1e-6)
        assert not there
        before = innovations.energies(beside[None])[0]
        assert energy <= before
        assert np.isfinite(before) or not np.isfinite(energy) or (end != beside).any()
