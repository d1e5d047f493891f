"""Sections and residues, and the sites that sample them."""

import math

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.data.scaling import TimeScale
from pyro_dynogp.lti.views import frequency_response, numerators, residues, steady_state_gain
from pyro_dynogp.models.gains import unit_direction
from pyro_dynogp.models.priors import CRITICAL, SETTLING, sample_modes

TYPICAL = TimeScale(1.0, 1000.0).typical_rate  # of the default time scale


def random_poles(count, seed):
    rng = np.random.default_rng(seed)
    return torch.as_tensor(-np.exp(rng.normal(size=count)) + 1j * np.exp(rng.normal(size=count)))


def test_residues_are_the_partial_fractions_of_the_section():
    poles = random_poles(4, 0)
    b = torch.randn(4, 2, 2, dtype=torch.float64)
    B = residues(poles, b)
    s = torch.tensor([0.0 + 0.7j, 0.3 + 2.0j], dtype=torch.complex128)
    for j in range(4):
        section = (b[j, :, 0] * s[:, None] + b[j, :, 1]) / ((s - poles[j]) * (s - poles[j].conj()))[
            :, None
        ]
        fractions = B[j] / (s - poles[j])[:, None] + B[j].conj() / (s - poles[j].conj())[:, None]
        torch.testing.assert_close(fractions, section, rtol=1e-12, atol=0)


def test_numerators_invert_residues():
    poles = random_poles(5, 1)
    B = torch.randn(5, 3, dtype=torch.complex128)
    torch.testing.assert_close(residues(poles, numerators(poles, B)), B, rtol=1e-12, atol=1e-13)


def test_second_gain_is_the_steady_state_gain():
    gain = torch.tensor([[[0.4, 1.7]]], dtype=torch.float64)
    with pyro.poutine.condition(data={"g_input_gain": gain, "g_feedthrough": torch.zeros(1)}):
        modes = sample_modes("g", inputs=1, pairs=1)
    assert float(steady_state_gain(modes)) == pytest.approx(1.7, rel=1e-10)


def test_nearly_double_poles_keep_accuracy():
    # The lowest frequency that the prior allows: residues are 50 times the gains, not more.
    values = {
        "g_log_decay": torch.tensor([0.3 - math.log(TYPICAL)], dtype=torch.float64),
        "g_log_frequency": torch.tensor([-9.0], dtype=torch.float64),
        "g_input_gain": torch.tensor([[[0.0, 1.0]]], dtype=torch.float64),
        "g_feedthrough": torch.zeros(1).double(),
    }
    with pyro.poutine.condition(data=values):
        modes = sample_modes("g", inputs=1, pairs=1)
    a = math.exp(0.3)
    omega = np.array([0.1, 1.0, 5.0])
    natural = abs(complex(modes.poles[0]))
    exact = natural**2 / ((1j * omega + a) ** 2 + complex(modes.poles[0]).imag ** 2)
    ours = frequency_response(modes, omega)[:, 0, 0].numpy()
    np.testing.assert_allclose(ours, exact, rtol=1e-11)
    assert complex(modes.poles[0]).imag == pytest.approx(CRITICAL * a, rel=0.01)


def test_unit_direction_has_unit_columns_with_positive_first_entries():
    raw = torch.randn(7, 3, 4, dtype=torch.complex128)
    c = unit_direction(raw)
    torch.testing.assert_close(c.abs().square().sum(-2), torch.ones(7, 4).double())
    torch.testing.assert_close(c[:, 0].imag, torch.zeros(7, 4).double(), atol=1e-15, rtol=0)
    assert bool((c[:, 0].real > 0).all())
    ratio = c / raw
    torch.testing.assert_close(ratio[:, 0], ratio[:, 2])  # one common factor for each column


@pytest.mark.parametrize("priors", ["default", "paper"])
@pytest.mark.parametrize("outputs", [None, 3])
@pytest.mark.parametrize("noise", ["shared", "independent"])
def test_every_site_changes_the_modes(priors, outputs, noise):
    """No decorative site: change one value and the system changes."""

    def system(values):
        with pyro.poutine.condition(data=values):
            modes = sample_modes(
                "g", inputs=2, pairs=2, outputs=outputs, noise=noise, priors=priors
            )
        lag = torch.tensor([0.0, 0.2], dtype=torch.float64)
        from pyro_dynogp.lti.covariance import autocovariance

        return torch.cat(
            [
                frequency_response(modes, np.array([0.3, 2.0])).abs().flatten(),
                autocovariance(modes, lag).flatten(),
            ]
        )

    with pyro.poutine.trace() as tracer, torch.random.fork_rng():
        torch.manual_seed(1)
        sample_modes("g", inputs=2, pairs=2, outputs=outputs, noise=noise, priors="default")
    values = {k: v["value"] for k, v in tracer.trace.nodes.items() if v["type"] == "sample"}
    before = system(values)
    assert len(values) == (7 if outputs else 6)
    for name, value in values.items():
        changed = system({**values, name: value + 0.1 * torch.rand_like(value) + 0.05})
        assert float((changed - before).abs().max()) > 1e-8, name


def test_signs_of_noise_zeros_are_fixed_only_where_they_cannot_be_seen():
    def support(**options):
        with pyro.poutine.trace() as tracer:
            sample_modes("g", inputs=0, **options)
        return type(tracer.trace.nodes["g_noise_gain_unit"]["fn"].base_dist).__name__

    assert support(pairs=1) == "HalfNormal"
    assert support(pairs=3, noise="independent") == "HalfNormal"
    assert support(pairs=3) == "Normal"
    assert support(pairs=1, outputs=2) == "Normal"
    assert support(pairs=1, brownian=2) == "Normal"


def test_poles_stay_within_what_the_record_can_show():
    scale = TimeScale(step=0.1, duration=50.0)
    with pyro.plate("draws", 500, dim=-1):
        modes = sample_modes("g", inputs=1, pairs=2, time_scale=scale)
    assert modes.batch_shape == (500,)
    decay = -modes.poles.real
    assert float(decay.max()) <= math.pi / 0.1
    # The root of a time constant is half-normal, here of a twentieth of the record on average.
    constant = 1.0 / decay
    assert float(constant.mean()) == pytest.approx(50.0 / (2 * SETTLING), rel=0.2)
    assert float((constant > 50.0 / 2).double().mean()) < 0.01
    assert float(modes.poles.imag.max()) <= math.pi / 0.1 * math.hypot(1.0, CRITICAL)


def test_unknown_priors_and_too_short_records_are_refused():
    with pytest.raises(ValueError, match="priors: expected 'default' or 'paper'"):
        sample_modes("g", inputs=1, pairs=1, priors="flat")
    with pytest.raises(ValueError, match="time_scale"):
        sample_modes("g", inputs=1, pairs=1, time_scale=TimeScale(1.0, 0.1))


def test_sampled_modes_drive_a_process_in_a_custom_model():
    time = np.arange(20) * 1.0

    def model():
        modes = dgp.sample_modes("g", inputs=1, pairs=2)
        return pyro.sample("h", dgp.LTIProcess(modes, time, np.ones((20, 1))))

    assert model().shape == (20,)
