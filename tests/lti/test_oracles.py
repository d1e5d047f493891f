"""The oracles' own matrix exponential against scipy's."""

import numpy as np
import pytest
import scipy.linalg

from tests.lti import oracles
from tests.lti.oracles import assert_close


@pytest.mark.parametrize("scale", [1e-8, 1e-2, 1.0, 30.0])
def test_matrix_exponential(scale):
    A = oracles.random_system(0).A
    M = scale * np.array([[0.0, 0.3], [1.0, 2.0]])[..., None, None] * A
    for i in range(2):
        for k in range(2):
            assert_close(oracles.expm(M)[i, k], scipy.linalg.expm(M[i, k]), rtol=1e-12)


@pytest.mark.parametrize("scale", [0.1, 5.0])
def test_matrix_that_is_not_normal(scale):
    M = scale * np.array([[-1.0, 20.0, 3.0], [0.0, -1.0, 7.0], [0.0, 0.0, -2.0]])
    assert_close(oracles.expm(M), scipy.linalg.expm(M), rtol=1e-12)
