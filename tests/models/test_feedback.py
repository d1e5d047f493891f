"""Static layers in feedback: a line closes the loop to a linear system, densely computed."""

import numpy as np
import pytest
import torch

from pyro_dynogp.models.outputs import output_process
from tests.models.closed_loops import ClosedLoop, make_record, spring, system_at, values_of

CASES = [(1, 1, False), (1, 1, True), (2, 1, False), (2, 2, True)]


def line_case(outputs, inputs, irregular, **options):
    model = spring(outputs, inputs=inputs, **options)
    record = make_record(inputs, outputs, irregular=irregular)
    model = model.scaled_to(record)
    system = system_at(model, values_of(model, record, seed=outputs + 2 * irregular))
    return record, ClosedLoop(model, system, record), output_process(system, model.scaling, record)


@pytest.mark.parametrize(("outputs", "inputs", "irregular"), CASES)
def test_a_line_in_feedback_is_a_linear_system(outputs, inputs, irregular):
    """Log density, and one step ahead mean and variance."""
    record, loop, process = line_case(outputs, inputs, irregular)
    y = record.tensors().observations
    total, means, covariances = loop.filter(loop.scaled(record.outputs))
    jacobian = (~np.isnan(record.outputs) * np.log(loop.scale)).sum()
    assert float(process.log_prob(y)) == pytest.approx(total - jacobian, rel=1e-10)
    found = process.ahead(y, 1)
    variance = np.diagonal(covariances, axis1=1, axis2=2) * loop.scale**2
    np.testing.assert_allclose(found.mean, loop.shift + loop.scale * means, rtol=1e-9)
    np.testing.assert_allclose(found.variance, variance, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(("outputs", "inputs", "irregular"), CASES)
def test_free_runs_of_a_line_in_feedback_are_those_of_the_linear_system(outputs, inputs, irregular):
    record, loop, process = line_case(outputs, inputs, irregular, process_noise=False)
    _, means, _ = loop.filter()
    found = process.components(samples=3, seed=0)
    for mean in found.mean:
        np.testing.assert_allclose(mean, loop.shift + loop.scale * means, rtol=1e-10)
    assert not found.variance.any()


@pytest.mark.parametrize(("outputs", "irregular"), [(1, False), (2, True)])
def test_process_noise_of_free_runs_is_that_of_the_linear_system(outputs, irregular):
    """Mean and variance over draws, within five standard errors."""
    count = 4000
    _, loop, process = line_case(outputs, 1, irregular)
    _, means, covariances = loop.filter()
    found = process.components(samples=count, seed=1).mean
    variance = np.diagonal(covariances, axis1=1, axis2=2) * loop.scale**2
    error = found.mean(0) - (loop.shift + loop.scale * means)
    assert (np.abs(error) < 5.0 * np.sqrt(variance / count) + 1e-9).all()
    ratio = found.var(0) / variance
    assert (np.abs(ratio[variance > 1e-12] - 1.0) < 5.0 * np.sqrt(2.0 / count)).all()
