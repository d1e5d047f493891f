"""One order of the pairs holds one of the P! copies of a vector, and no density is lost."""

import itertools
import math

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.cascade_coordinates import StraightPotential
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.annealed import Joint
from pyro_dynogp.inference.pair_order import PairOrder
from tests.inference.test_linear_density import drawn


def permuted(potential, order, values, places):
    places = torch.tensor(places)
    return {
        name: value.index_select(order.axes[name], places) if name in order.axes else value
        for name, value in values.items()
    }


@pytest.mark.parametrize("name", ["three pairs", "two outputs, integrators", "two inputs"])
def test_exactly_one_order_of_every_vector(name):
    potential, z = drawn(name, 6)
    order = PairOrder.around(potential, z[0].numpy())
    pairs = len(order.centre)
    assert order.log_orders == pytest.approx(math.log(math.factorial(pairs)))
    assert order.holds(z[:1].numpy()).all()
    for one in z:
        values = potential.unpack(one)
        copies = [permuted(potential, order, values, places)
                  for places in itertools.permutations(range(pairs))]  # fmt: skip
        vectors = torch.stack([potential.pack(copy) for copy in copies])
        energies = potential.values_and_gradients(vectors.numpy())[0]
        np.testing.assert_allclose(energies, energies[0], rtol=1e-9)  # copies indeed
        inside = order.holds(vectors.numpy())
        assert inside.sum() == 1
        put = potential.pack(order.put(potential, copies[-1]))
        torch.testing.assert_close(put, vectors[int(np.flatnonzero(inside)[0])])


def test_a_density_outside_of_the_order_is_zero():
    potential, z = drawn("three pairs", 8)
    order = PairOrder.around(potential, z[0].numpy())
    inside = order.holds(z.numpy())
    assert 0 < inside.sum() < 8
    whole, one = Joint(potential, 40), Joint(potential, 40, order)
    (value, slope), (some, turned) = whole(z), one(z)
    np.testing.assert_array_equal(np.isfinite(some.numpy()), inside)
    torch.testing.assert_close(some[inside], value[inside])
    torch.testing.assert_close(turned[inside], slope[inside])
    assert not turned[~inside].any()
    np.testing.assert_allclose(one.log_prob(z), some.numpy(), rtol=1e-13)


def test_straight_coordinates_keep_the_order():
    """Their poles are those of the plain ones."""
    potential, z = drawn("three pairs", 8)
    values = potential.unpack(z)
    straight = StraightPotential(potential.model, potential.args, potential.at)
    orders = [PairOrder.around(one, z[0].numpy()) for one in (potential, straight)]
    packed = straight.pack(values).numpy()
    np.testing.assert_array_equal(orders[0].holds(z.numpy()), orders[1].holds(packed))


def test_other_models_have_none():
    model = dgp.Wiener(1, pairs=2, inducing=4)
    potential = drawn("Wiener")[0]
    assert model.has_function
    assert PairOrder.around(potential, np.zeros(potential.size)) is None
    assert not PairOrder.around(drawn("one pair")[0], np.zeros(8)).log_orders


def test_what_is_no_number_is_in_no_order():
    potential, z = drawn("three pairs", 3)
    order = PairOrder.around(potential, z[0].numpy())
    points = z.numpy().copy()
    points[0] = np.nan
    assert not order.holds(points)[0]
    assert isinstance(potential, Potential)
