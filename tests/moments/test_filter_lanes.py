"""The filter in lanes against the filter of one point."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.plans import starting_points
from pyro_dynogp.lti.lanes import WIDTH
from pyro_dynogp.moments import smoothing
from pyro_dynogp.moments.lane_passes import FEWEST, innovate_together, lanes_serve
from pyro_dynogp.moments.problem import EVENTS, log_density
from tests.inference.test_log_joint import GAPS
from tests.moments.problems import LINE, WIDE, Block, random_problem

STUDENT = {
    "heavy tails": ([LINE], {"student": True}),
    "heavy tails, two outputs": ([Block("rbf", 2, 2), LINE], {"student": True, "n_y": 2}),
}
TABLES = {
    "one table": ([LINE], {}),
    "two tables in a row": ([LINE, LINE], {"pairs": 3}),
    "two outputs of a table, two of the record": ([WIDE, LINE], {"n_y": 2, "pairs": 1}),
    "no function": ([], {"n_y": 2}),
    "one step": ([LINE], {"distinct": 1, "repeated": False}),
    "a measured function": ([LINE], {"measured": True}),
    "a measured function of another": ([WIDE, LINE], {"measured": True, "pairs": 3}),
    "a measured function, heavy tails": ([LINE], {"measured": True, "student": True}),
}
RADIAL = {
    kernel: ([Block(kernel, 2, 2), LINE, Block(kernel, 3)], {"pairs": 1})
    for kernel in ("rbf", "matern12", "matern32", "matern52")
}


def together(problems):
    """Problems with one layout and one y as one of several points."""
    return replace(
        problems[0],
        **{
            name: torch.stack([getattr(one, name) for one in problems])
            for name in EVENTS
            if name != "y"
        },
    )


def points(case, count):
    """Problems of one kind with numbers of their own."""
    blocks, options = {**TABLES, **RADIAL, **STUDENT}[case]
    first = random_problem(blocks, **options)
    others = [random_problem(blocks, **options, seed=s) for s in range(1, count)]
    return [first, *(replace(one, layout=first.layout, y=first.y) for one in others)]


def one_by_one(problems):
    """Errors, variances and log-densities (k, n, n_y) of each problem by itself."""
    found = []
    for problem in problems:
        (values,), _ = problem.elements()
        found.append(smoothing.innovate(problem.layout, values))
    return [np.stack(part) for part in zip(*found, strict=True)]


def test_errors_without_bound_have_no_density_and_no_warning():
    problems = [
        replace(one, y=torch.full_like(one.y, 1e200)) for one in points("one table", FEWEST)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # that none is seen is what is tested
        _, variance, density = innovate_together(together(problems))
    assert np.isfinite(variance).any()
    assert (density[np.isfinite(variance)] == -np.inf).all()


@pytest.mark.parametrize("count", [FEWEST, WIDTH, WIDTH + 3])
@pytest.mark.parametrize("case", TABLES)
def test_tables_have_the_same_bits(case, count):
    problems = points(case, count)
    *both, density = innovate_together(together(problems))
    *alone, expected = one_by_one(problems)
    for ours, theirs in zip(both, alone, strict=True):
        assert np.isnan(theirs).any()
        np.testing.assert_array_equal(ours, theirs)
    # Logarithms are numpy's in lanes and the compiler's at one point.
    np.testing.assert_allclose(density, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("case", [*RADIAL, *STUDENT])
def test_radial_functions_and_heavy_tails(case):
    """Exponentials have another last bit."""
    problems = points(case, 5)
    for ours, alone in zip(
        innovate_together(together(problems)), one_by_one(problems), strict=True
    ):
        np.testing.assert_allclose(ours, alone, rtol=1e-11, atol=1e-12)


def test_batches_of_several_dimensions_and_shared_numbers():
    """What no point has of its own goes through once for all."""
    problems = points("two tables in a row", 6)
    whole = together(problems)
    own = {name: getattr(whole, name) for name in EVENTS if name not in ("y", "R")}
    own = {name: x.reshape(2, 3, *x.shape[1:]) for name, x in own.items()}
    shaped = replace(whole, **own, R=problems[0].R)
    alone = one_by_one([replace(one, R=problems[0].R) for one in problems])
    for ours, expected in zip(innovate_together(shaped)[:2], alone[:2], strict=True):
        assert ours.shape == (2, 3, *problems[0].y.shape)
        np.testing.assert_array_equal(ours.reshape(expected.shape), expected)


def test_outliers_far_beyond_what_exponentials_hold():
    """A residual of 1e6 standard deviations: the widest of the Gaussians has all the weight."""
    problems = points("heavy tails", FEWEST)
    y = problems[0].y.clone()
    y[int(torch.argwhere(~y.isnan().any(1))[3])] += 1e6
    problems = [replace(one, y=y) for one in problems]
    density = innovate_together(together(problems))[2]
    assert np.isfinite(density[:, ~y.isnan().any(1)]).all()
    # Exponentials have another last bit, as above.
    np.testing.assert_allclose(density, one_by_one(problems)[2], rtol=1e-11)


def test_a_variance_below_zero_is_no_density_and_no_warning():
    problems = points("one table", 4)
    problems[1] = replace(problems[1], R=-1e3 * problems[1].R)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # none may come
        _, variance, density = innovate_together(together(problems))
    assert np.nanmin(variance[1]) < 0.0
    assert np.isnan(density[1][variance[1] < 0.0]).all()
    there = ~torch.isnan(problems[0].y).numpy()
    assert np.isfinite(density[0][there]).all()


@pytest.mark.parametrize("case", ["one table", "a measured function"])
def test_a_point_without_a_density_leaves_the_others_alone(case):
    problems = points(case, 4)
    spoiled = [*problems]
    spoiled[1] = replace(problems[1], R=problems[1].R * torch.nan)
    clean, found = innovate_together(together(problems)), innovate_together(together(spoiled))
    assert np.isnan(found[1][1]).all()
    for before, after in zip(clean, found, strict=True):
        np.testing.assert_array_equal(before[[0, 2, 3]], after[[0, 2, 3]])


@pytest.mark.parametrize("likelihood", [dgp.Gaussian(), dgp.StudentT(3.0)])
def test_a_point_that_breaks_has_no_density_beside_others(likelihood):
    """Not that of the samples before it breaks; missing samples count nothing."""
    problem = Problem.of(dgp.NonlinearFeedback(1, inducing=8, likelihood=likelihood), GAPS)
    (start,) = starting_points(problem.target, problem.records, Run(workers=1), count=1, steps=3)
    density = Potential(problem.target, (problem.records,), start).log_density
    several = {name: x.expand(FEWEST, *x.shape).clone() for name, x in start.items()}
    y = density.observations[0]
    whole = density.outputs(several)[0].log_prob(y)
    several["g_initial_state"][1] = torch.inf
    broken = density.outputs(several)[0].log_prob(y)
    assert torch.isfinite(whole).all()
    assert not torch.isfinite(broken[1])
    assert torch.equal(broken[[0, 2]], whole[[0, 2]])


@pytest.mark.parametrize(
    "case", ["two outputs of a table, two of the record", "a measured function", *STUDENT]
)
def test_densities_are_those_of_the_filter(case):
    """They add up to the density of one point."""
    problems = points(case, 4)
    each = innovate_together(together(problems))[2]
    expected = [float(log_density(one)) for one in problems]
    np.testing.assert_allclose(np.nansum(each, (1, 2)), expected, rtol=1e-12)


def test_what_goes_through_in_lanes():
    problems = points("one table", FEWEST)
    assert lanes_serve(together(problems))
    assert not lanes_serve(together(problems[:-1]))
    own = replace(together(problems), y=torch.stack([one.y for one in problems]))
    assert not lanes_serve(own)
    assert lanes_serve(together(points("heavy tails", FEWEST)))
    assert lanes_serve(together(points("a measured function", FEWEST)))
