"""Rounds of importance sampling: known densities, shares of peaks, evidence, when they end."""

import math

import numpy as np
import pytest
import torch
from scipy.special import logsumexp

from pyro_dynogp.inference.adaptive_importance import adapt
from pyro_dynogp.inference.student_mixture import StudentMixture


def tensor(x):
    return torch.tensor(x, dtype=torch.float64)


def student(centres, sd=1.0):
    loc = tensor(centres)
    root = sd * torch.eye(loc.shape[1], dtype=torch.float64).expand(len(loc), -1, -1)
    return StudentMixture(torch.full((len(loc),), 1.0 / len(loc), dtype=torch.float64), loc, root)


def normal(z, centre, sd):
    off = (z - tensor(centre)) / tensor(sd)
    return (-0.5 * off.square() - tensor(sd).log() - 0.5 * math.log(2 * math.pi)).sum(-1)


def never(found):
    return False


def evidence(found):
    return float(logsumexp(found.log_target - found.log_proposal)) - math.log(len(found.z))


CENTRE, SDS = [1.5, -2.0, 0.5], [0.2, 3.0, 1.0]


@pytest.mark.parametrize("seed", range(3))
def test_a_normal_far_from_where_the_rounds_begin(seed):
    def target(z):
        return (normal(z, CENTRE, SDS) + 2.0).numpy()

    start = student([[0.0, 0.0, 0.0]])
    first = adapt(start, target, 400, seed, never, 1)
    found = adapt(start, target, 400, seed, never, 6)
    assert first.rounds == 1
    assert found.rounds == 6
    assert len(found.z) == 2400
    assert found.k < 0.6 < first.k
    assert found.effective > 1000.0 > 5.0 * first.effective
    assert evidence(found) == pytest.approx(2.0, abs=0.05)
    w = np.exp(found.log_weights)
    mean = w @ found.z.numpy()
    assert (np.abs(mean - CENTRE) < 0.15 * np.array(SDS)).all()
    root = found.proposal.scale_tril[0]
    sd = (root @ root.mT).diagonal().sqrt().numpy()
    np.testing.assert_allclose(sd, SDS, rtol=0.2)
    assert (np.abs(found.proposal.loc[0].numpy() - CENTRE) < 0.2 * np.array(SDS)).all()


def test_densities_are_of_the_mixture_of_all_rounds():
    found = adapt(student([[0.0]], 2.0), lambda z: normal(z, [1.0], [1.0]).numpy(), 50, 0, never, 3)
    again = adapt(student([[0.0]], 2.0), lambda z: normal(z, [1.0], [1.0]).numpy(), 50, 0, never, 1)
    two = adapt(student([[0.0]], 2.0), lambda z: normal(z, [1.0], [1.0]).numpy(), 50, 0, never, 2)
    proposals = [student([[0.0]], 2.0), again.proposal, two.proposal]
    each = np.stack([one.log_prob(found.z).numpy() for one in proposals])
    np.testing.assert_allclose(found.log_proposal, logsumexp(each, 0) - math.log(3.0), rtol=1e-12)
    assert torch.equal(found.z[:50], again.z)


def test_two_peaks_keep_their_shares():
    """Masses 0.8 and 0.2, while both components begin with one half."""

    def target(z):
        one = normal(z, [-5.0, 0.0], [0.5, 0.5]) + math.log(0.8)
        return torch.logaddexp(one, normal(z, [5.0, 1.0], [1.5, 0.3]) + math.log(0.2)).numpy()

    found = adapt(student([[-5.0, 0.0], [5.0, 0.0]]), target, 500, 0, never, 5)
    share = np.exp(found.log_weights) @ (found.z[:, 0] > 0.0).double().numpy()
    assert share == pytest.approx(0.2, abs=0.03)
    assert float(found.proposal.weights[1]) == pytest.approx(0.2, abs=0.05)
    assert evidence(found) == pytest.approx(0.0, abs=0.06)


def test_rounds_end_when_there_is_enough():
    def target(z):
        return normal(z, [0.0], [1.0]).numpy()

    def ended(*rounds):
        return adapt(student([[0.0]]), target, 100, 0, lambda now: now.rounds in rounds, 6)

    assert (ended(1).rounds, ended(1).settled) == (1, True)  # looked at once
    assert (ended(3).rounds, ended(3).settled) == (6, False)  # a chance among several
    assert (ended(3, 4).rounds, ended(3, 4).settled) == (4, True)
    assert (ended(6).rounds, ended(6).settled) == (6, False)
    assert torch.equal(ended(3, 4).z, adapt(student([[0.0]]), target, 100, 0, never, 4).z)


def test_nothing_to_shape_by():
    found = adapt(student([[0.0]]), lambda z: np.full(len(z), -np.inf), 100, 0, never, 8)
    assert found.rounds == 1
