"""Systems for python-control respond as the fit does."""

import sys

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.criticism.control_bridge import matrices, modes_of
from pyro_dynogp.lti.views import frequency_response, step_response

QUICK = {"restarts": 1, "workers": 1, "progress": False, "steps": 4}
OMEGA = np.array([0.1, 0.7, 3.0, 20.0])


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=(30, 2)), 4, axis=0)
    y = np.column_stack([np.convolve(u[:, k], 0.7 ** np.arange(20))[:120] for k in (0, 1)])
    return dgp.Record(
        0.25 * np.arange(120), u, y + 0.1 * rng.normal(size=y.shape),
        input_names=("a", "b"), output_names=("y", "z"),
    )  # fmt: skip


@pytest.fixture(scope="module")
def fit(record):
    model = dgp.LinearDynamicGP(2, outputs=2, pairs=2)
    return dgp.fit(model, record, method="svi", draws=7, **QUICK)


@pytest.fixture(scope="module")
def bent(record):
    model = dgp.Wiener(2, pairs=1, inducing=5)
    one = record.select(outputs="y")
    return dgp.fit(model, one, method="map", **QUICK)


def test_matrices_have_the_response_of_the_fit(fit):
    (modes,), names = modes_of(fit, None, None)
    assert names == {"inputs": ["a", "b"], "outputs": ["y", "z"]}
    expected = fit.at_mode().modes
    assert torch.equal(modes.poles, expected.poles)
    A, B, C, D = matrices(modes, None)
    eye = np.eye(len(A))
    found = [C @ np.linalg.solve(1j * w * eye - A, B) + D for w in OMEGA]
    np.testing.assert_allclose(found, frequency_response(expected, OMEGA), rtol=1e-9, atol=1e-12)


def test_sampled_systems_step_as_held_inputs_do(fit):
    (modes,), _ = modes_of(fit, None, None)
    A, B, C, D = matrices(modes, 0.25)
    state, found = np.zeros((len(A), 2)), []
    for _ in range(40):
        found.append(C @ state + D)
        state = A @ state + B
    time = 0.25 * np.arange(40)
    np.testing.assert_allclose(found, step_response(modes, time), rtol=1e-8, atol=1e-10)


def test_draws_are_those_of_the_fit(fit):
    several, _ = modes_of(fit, 3, None)
    for modes, k in zip(several, (0, 3, 6), strict=True):
        assert torch.equal(modes.poles, fit.modes.poles[k])
    assert len(modes_of(fit, 100, None)[0]) == 7


def test_layers(bent):
    (modes,), names = modes_of(bent, None, "g")
    assert names == {}
    assert torch.equal(modes.poles, bent.system_at(bent.mode).layer("g").modes.poles)
    with pytest.raises(ValueError, match=r"layer: .*'g'.*got None"):
        bent.to_control()


def test_without_the_package(fit, monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(ImportError, match="pip install control"):
        fit.to_control()


@pytest.mark.parametrize("kind", ["state space", "transfer function"])
class TestControl:
    @pytest.fixture(autouse=True)
    def control(self):
        return pytest.importorskip("control")

    def test_continuous(self, kind, fit):
        system = fit.to_control(kind=kind)
        assert (system.input_labels, system.output_labels) == (["a", "b"], ["y", "z"])
        found = np.moveaxis(system(1j * OMEGA), 2, 0)
        expected = frequency_response(fit.at_mode().modes, OMEGA)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)

    def test_sampled(self, kind, fit):
        system = fit.to_control(kind=kind, step=0.25)
        assert system.dt == 0.25
        (modes,), _ = modes_of(fit, None, None)
        A, B, C, D = matrices(modes, 0.25)
        z = np.exp(0.25j * OMEGA[:3])
        expected = [C @ np.linalg.solve(one * np.eye(len(A)) - A, B) + D for one in z]
        np.testing.assert_allclose(np.moveaxis(system(z), 2, 0), expected, rtol=1e-6, atol=1e-9)

    def test_draws(self, kind, fit):
        systems = fit.to_control(kind=kind, draws=7)
        found = np.stack([np.moveaxis(system(1j * OMEGA), 2, 0) for system in systems])
        expected = frequency_response(fit.modes, OMEGA)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
        (system,) = fit.at_mode().to_control(kind=kind, draws=1)
        assert system.noutputs == 2
