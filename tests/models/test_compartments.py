"""Chains of compartments, and the real poles that they are made of."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import quad

import pyro_dynogp as dgp
from pyro_dynogp.inference import refit as refits
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.stability import of_poles
from pyro_dynogp.inference.starts.dynamic import RATES, UNFED
from pyro_dynogp.inference.starts.plans import Plan, starting_point
from pyro_dynogp.layers.sites import sample
from pyro_dynogp.lti.covariance import stationary_variance
from pyro_dynogp.lti.views import steady_state_gain
from pyro_dynogp.models.compartments import in_place_of
from pyro_dynogp.models.description import describe
from pyro_dynogp.models.feedback_variants import with_feedback, with_forms, with_products
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.priors import LASTING, SETTLING, ModesPrior
from pyro_dynogp.models.variants import with_integrator
from pyro_dynogp.support.frozen import FrozenMapping
from tests.models.closed_loops import check_gradient, make_record, system_at
from tests.models.test_forms import MIDDLE, PLAIN
from tests.models.test_known import values_at


def standardised(form, at, width):
    """A form in numpy, less its mean for standard normal signals and over its size there."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(11)
    weights = weights / weights.sum()
    typical = PLAIN[form](nodes, *MIDDLE[form])
    level = weights @ typical
    size = np.sqrt(weights @ (typical - level) ** 2)
    return lambda x: (PLAIN[form](np.clip(x, -7.98, 7.98), at, width) - level) / size


def test_a_real_pole_is_a_first_order_lag():
    prior = ModesPrior("g", inputs=2, pairs=3, real=True, process_noise=False)
    torch.manual_seed(0)
    values = sample(prior.sites())
    assert {name: tuple(x.shape) for name, x in values.items()} == {
        "g_log_decay": (3,), "g_input_gain": (3, 2, 1), "g_feedthrough": (2,)
    }  # fmt: skip
    modes = prior.modes(values)
    decay = prior.time_scale.typical_rate * values["g_log_decay"].exp()
    gain = values["g_input_gain"][..., 0]
    assert bool((modes.poles.imag == 0.0).all())
    torch.testing.assert_close(-modes.poles.real, decay)
    time = torch.linspace(0.0, 5.0, 7, dtype=torch.float64) / decay.mean()
    found = 2.0 * ((modes.poles[:, None] * time).exp() * modes.B[:, :1]).real.sum(0)
    rate = prior.time_scale.typical_rate
    expected = (gain[:, :1] * rate * (-decay[:, None] * time).exp()).sum(0)
    torch.testing.assert_close(found, expected)
    held = steady_state_gain(modes).reshape(-1)
    torch.testing.assert_close(
        held, (gain * rate / decay[:, None]).sum(0) + values["g_feedthrough"]
    )


def test_noise_of_a_real_pole_has_the_size_of_that_of_a_pair():
    """Its gain is the output's standard deviation where it decays at the typical rate."""
    for real, terms in ((True, [0.7]), (False, [0.0, 0.7])):
        prior = ModesPrior("g", inputs=0, pairs=1, real=real)
        values = {
            "g_log_decay": torch.zeros(1, dtype=torch.float64),
            "g_log_frequency": torch.full((1,), -9.0, dtype=torch.float64),
            "g_noise_gain_local_scale": torch.tensor([10.0], dtype=torch.float64),  # of 0.1
            "g_noise_gain_unit": torch.tensor([[terms]], dtype=torch.float64),
        }
        modes = prior.modes(values)
        variance = stationary_variance(modes).reshape(())
        # A pair is a double real pole up to 4e-4, see `CRITICAL`.
        assert float(variance.sqrt()) == pytest.approx(0.7, rel=1e-3)


def test_free_runs_are_those_of_a_plain_simulation():
    """Flows are held for a third of each step; the second sees the mean of the first's level."""
    record = make_record(missing=False)
    model = dgp.Compartments(1, process_noise=False).scaled_to(record)
    values = values_at(model, 2)
    place = {"root1": (-1.1, None), "edge1": (0.3, 0.2), "root2": (-1.6, None), "edge2": (0.2, 0.3)}
    for name, (at, width) in place.items():
        values[f"{name}_at"] = torch.tensor(at, dtype=torch.float64)
        if width is not None:
            values[f"{name}_width"] = torch.tensor(width, dtype=torch.float64)
    flows = {name: standardised(name[:-1], *both) for name, both in place.items()}
    system, scaling = system_at(model, values), model.scaling
    layers = [system.layer(f"level{k}") for k in (1, 2)]
    decay = [float(-layer.modes.poles.real[0]) for layer in layers]
    gains = [2.0 * layer.modes.B.real[0].numpy() for layer in layers]  # with the conjugates
    x = [2.0 * float(layer.first_state.real[0]) for layer in layers]
    offset = float(values["offset"])
    u = ((record.inputs[:, 0] - scaling.input_offset) / scaling.input_scale).ravel()
    expected = []
    for k, step in enumerate(np.diff(record.time, append=record.time[-1] + 0.1)):
        expected.append(x[1] + offset)
        for _ in range(3):
            h = step / 3.0
            first = [flows[name](x[0]) for name in ("root1", "edge1")]
            second = [flows[name](x[1] + offset) for name in ("root2", "edge2")]
            drive = gains[0] @ np.array([u[k], *first])
            held = gains[1] @ np.array([0.0, *first, *second])

            def above(t, x=x[0], drive=drive):
                return np.exp(-decay[0] * t) * x - drive * np.expm1(-decay[0] * t) / decay[0]

            total = held + gains[1][0] * quad(above, 0.0, h)[0] / h
            x = [
                above(h),
                np.exp(-decay[1] * h) * x[1] - total * np.expm1(-decay[1] * h) / decay[1],
            ]
    (prepared,) = model.prepare(record)
    found = output_process(system, prepared).one_step(prepared.observations).mean.numpy()
    found = ((found - scaling.output_offset) / scaling.output_scale).ravel()
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("process_noise", [False, True])
def test_gradient_is_that_of_finite_differences(process_noise):
    record = make_record(n=25)
    model = dgp.Compartments(1, process_noise=process_noise).scaled_to(record)
    values = values_at(model, 1)
    values |= {name: x.clamp_min(0.3) for name, x in values.items() if name.endswith("_width")}
    check_gradient(Potential(model, (model.prepare(record),), values))


def test_every_site_matters():
    record = make_record()
    model = dgp.Compartments(1).scaled_to(record)
    values = values_at(model, 0)
    values |= {name: x.clamp_min(0.3) for name, x in values.items() if name.endswith("_width")}
    (prepared,) = model.prepare(record)

    def density(given):
        process = output_process(system_at(model, given), prepared)
        return float(process.log_prob(prepared.observations))

    start = density(values)
    for name, value in values.items():
        for place in range(value.numel()):
            moved = value.flatten().clone()
            moved[place] = moved[place] * 1.1 + 0.01
            changed = density(values | {name: moved.reshape(value.shape)})
            assert abs(changed - start) > 1e-7, (name, place)


@pytest.mark.parametrize(
    "options",
    [
        {"outputs": 2},
        {"integrators": 1},
        {"brownian": 2},
        {"hidden": 1, "feedback": ("f",)},
    ],
)
def test_real_poles_of_several_signals_are_refused(options):
    layers = (dgp.Dynamic(real=True, name="g", **options), dgp.Static(name="f"))
    with pytest.raises(ValueError, match="real of layer 'g': expected False for several outputs"):
        dgp.Cascade(1, layers, output="g" if "feedback" in options else None)


def test_real_poles_without_a_function_are_refused():
    with pytest.raises(ValueError, match="real of layer 'g': expected False in a model without"):
        dgp.Cascade(1, (dgp.Dynamic(real=True),))
    with pytest.raises(ValueError, match="real of layer 'g': expected True or False, got 1"):
        dgp.Cascade(1, (dgp.Dynamic(real=1), dgp.Static()))
    with pytest.raises(ValueError, match="count: expected a whole number >= 1, got 0"):
        dgp.Compartments(1, count=0)


def test_starts_have_the_signs_of_the_linear_fit():
    """Levels rise with what they see and fall by what comes back; rates are around the fit's."""
    record = make_record(inputs=2, n=60)
    model = dgp.Compartments(2).scaled_to(record)
    linear = values_at(dgp.LinearDynamicGP(2, pairs=1).scaled_to(record), 0)
    linear["g_input_gain"] = torch.tensor([[[9.0, 0.5], [-9.0, -0.5]]], dtype=torch.float64)
    linear["g_log_decay"] = linear["g_log_frequency"] = torch.full((1,), -1.0).double()
    found = []
    for seed in range(30):
        plan = Plan("level1", linear, False, seed)
        start = starting_point(model, model.prepare(record), plan)
        first, second = (start[f"level{k}_input_gain"][0, :, 0] for k in (1, 2))
        assert first.sign().tolist() == [1.0, -1.0, -1.0, -1.0]
        assert second.sign().tolist() == [1.0, 1.0, 1.0, -1.0, -1.0]
        found += [float(start[f"level{k}_log_decay"]) for k in (1, 2)]
    expected = np.log(UNFED) - 1.0 + 0.5 * np.log(2.0)
    assert np.mean(found) == pytest.approx(expected, abs=4.0 * RATES / np.sqrt(len(found)))
    # Of sixty normal numbers, whose standard deviation has an error of a tenth.
    assert np.std(found) == pytest.approx(RATES, rel=0.4)


def test_the_loop_puts_them_in_place_of_linear_dynamics():
    channel = dgp.Delayed("u", 0.3)
    model = dgp.LinearDynamicGP(1, pairs=3, channels=(channel,))
    chain = in_place_of(model, 2)
    assert [w.name for w in chain.wires] == [w.name for w in dgp.Compartments(1).wires]
    assert chain.channels == (channel,)
    assert chain.has_real_poles
    assert not model.has_real_poles
    refused = [
        chain,
        dgp.Wiener(1),
        dgp.LinearDynamicGP(1, outputs=2),
        dgp.LinearDynamicGP(1, integrators=1),
        dgp.LinearDynamicGP(1, channels=(dgp.Delayed("u"),)),
        replace(model, likelihood=dgp.StudentT()),
    ]
    assert [in_place_of(one, 2) for one in refused] == [None] * len(refused)


def test_what_does_not_go_with_real_poles_is_not_added():
    model = dgp.Compartments(1)
    assert with_integrator(model) is None
    assert with_feedback(model, output=False, hidden=True) is None
    assert with_forms(model, hidden=True) is None
    assert with_products(model, hidden=True) is None
    assert with_feedback(model) is None  # forms of its level come back already


def test_units_do_not_matter_and_files_keep_it(tmp_path):
    """Records in other units have the same posterior; real poles have no imaginary states."""
    record = make_record(inputs=2, n=60)
    other = replace(record, inputs=record.inputs[:, ::-1] * 3.0, outputs=5.0 * record.outputs)
    options = {"method": "map", "restarts": 2, "steps": 3, "workers": 1, "progress": False}
    model = dgp.Compartments(2, process_noise=False)
    one, two = (dgp.fit(model, r, **options) for r in (record, other))
    gain = two.mode["level1_input_gain"]
    swapped = torch.cat([gain[:, [1, 0]], gain[:, 2:]], 1)
    torch.testing.assert_close(one.mode["level1_input_gain"], swapped)
    assert one.mode["level1_initial_state"].shape == (1,)
    one.save(tmp_path / "fit.json")
    again = dgp.load(tmp_path / "fit.json")
    assert again.model == one.model


def test_its_description_says_that_poles_are_real():
    dynamics = [part for part in describe(dgp.Compartments(1)) if part.kind == "dynamics"]
    assert [part.details for part in dynamics] == ["1 real pole, process noise"] * 2


def test_poles_in_feedback_may_be_slow():
    """What comes back decides how fast a level settles: no prior against it, and no warning."""
    rates = {
        (real, fed): ModesPrior("g", inputs=2, pairs=1, real=real, fed=fed).sites()[0].prior
        for real in (True, False)
        for fed in (0, 1)
    }
    slow = {kind: float(prior.base_dist.rate) for kind, prior in rates.items()}
    assert slow[True, 0] == slow[False, 0] == slow[False, 1]
    assert slow[True, 1] == pytest.approx(slow[True, 0] * LASTING / SETTLING)
    record = make_record(n=60)
    options = {"method": "map", "restarts": 1, "steps": 1, "workers": 1, "progress": False}
    lag = dgp.Cascade(1, (dgp.Dynamic(pairs=1, real=True, process_noise=False), dgp.Static()))
    for model, name, warned in ((dgp.Compartments(1), "level1", 0), (lag, "g", 1)):
        fit = dgp.fit(model, record, **options)
        slowest = {f"{name}_log_decay": torch.full((1,), -9.0, dtype=torch.float64)}
        slowed = replace(fit, mode=FrozenMapping({**fit.mode, **slowest}))
        assert len([said for said in of_poles(slowed) if "decays so slowly" in said]) == warned


def test_refits_in_place_of_linear_dynamics_start_afresh(monkeypatch):
    """Nothing that pairs have learnt goes over to real poles; a chain goes on from its own."""
    record, asked = make_record(n=60), []
    options = {"method": "map", "restarts": 1, "steps": 2, "workers": 1, "progress": False}
    fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=2), record, **options)
    starting_points = refits.starting_points

    def counted(model, records, run, *, count, steps):
        asked.append(count)
        return starting_points(model, records, run, count=2, steps=2)

    monkeypatch.setattr(refits, "starting_points", counted)
    run = Run(seed=0, workers=1, steps=2)
    chain = refits.refit(fit, record, model=in_place_of(fit.model, 2), run=run)
    assert asked == [refits.REPLACED]
    refits.refit(chain, record[:50], model=replace(chain.model, scaling=None), run=run)
    assert asked == [refits.REPLACED]
