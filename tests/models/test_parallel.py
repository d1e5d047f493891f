"""Branches side by side: layers that see earlier signals by name."""

import numpy as np
import pytest
import torch
from gpytorch.kernels import RQKernel

import pyro_dynogp as dgp
from pyro_dynogp.inference.starts.plans import Plan, starting_point
from pyro_dynogp.layers.sites import sample
from pyro_dynogp.models.outputs import output_process
from tests.models.closed_loops import make_record, system_at


def response(modes, step, u):
    """Output (n,) of modes at rest for held inputs u (n, d), by the recursion of its poles."""
    lam, B = modes.poles.numpy(), modes.B.numpy()
    C, D = modes.C.numpy()[0], modes.D.numpy()[0]
    x, out = np.zeros(len(lam), complex), np.empty(len(u))
    for k, now in enumerate(u):
        out[k] = 2.0 * (C @ x).real + D @ now
        x = np.exp(lam * step) * x + np.expm1(lam * step) / lam * (B @ now)
    return out


def parallel(record, **options):
    model = dgp.ParallelWienerHammerstein(
        1, pairs=(1, 2), inducing=8, integrate="all", initial_state="zero", **options
    ).scaled_to(record)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        values = sample(model.all_sites(model.scaling, 1))
    return model, values


def test_the_branches_add_up():
    """Without noise the output is that of each branch by itself, computed by plain recursions."""
    record = make_record(missing=False)
    model, values = parallel(record, process_noise=False)
    system = system_at(model, values)
    u = (record.inputs - model.scaling.input_offset) / model.scaling.input_scale
    step, branches = float(record.time[1] - record.time[0]), []
    for branch in "12":
        g = response(system.layer(f"g{branch}").modes, step, u)
        f = system.layer(f"f{branch}").function.mean(torch.tensor(g)[:, None])
        branches.append(f.numpy()[:, 0])
    last = system.layer("g3").modes
    each = [
        response(last, step, np.stack([f * (k == own) for k, f in enumerate(branches)], -1))
        for own in range(2)
    ]
    expected = sum(each) + float(values["offset"])
    expected = model.scaling.output_offset[0] + model.scaling.output_scale[0] * expected
    (prepared,) = model.prepare(record)
    process = output_process(system, prepared)
    found = process.ahead(prepared.observations, 1).mean
    functions = system.layer("f1").function, system.layer("f2").function
    assert all(f.channels == 1 for f in functions)
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-9)


def test_each_function_has_exact_scalar_moments():
    """Any kernel fits, since none sees several channels."""
    record = make_record()
    model, values = parallel(record, kernel=RQKernel())
    (prepared,) = model.prepare(record)
    density = output_process(system_at(model, values), prepared).log_prob(prepared.observations)
    assert bool(density.isfinite())


WRONG = [
    (dgp.Static(sees=("g9",)), "sees of layer 'f'"),
    (dgp.Static(sees=("g", "g")), "sees of layer 'f'"),
    (dgp.Static(sees="g"), "sees of layer 'f'"),
    (dgp.Static(sees=("g",), skip=("inputs",)), "sees or skip"),
    (dgp.Static(skip=("g",)), "skip of layer 'f'"),
]


@pytest.mark.parametrize(("layer", "message"), WRONG)
def test_signals_that_are_not_there_are_refused(layer, message):
    with pytest.raises(ValueError, match=message):
        _ = dgp.Cascade(1, (dgp.Dynamic(), layer))


def test_a_branch_that_leads_nowhere_is_refused():
    layers = (dgp.Dynamic(), dgp.Static(), dgp.Dynamic(sees=("inputs",)))
    with pytest.raises(ValueError, match="without effect"):
        _ = dgp.Cascade(1, layers)


def test_a_layer_beside_the_leading_one_starts_with_its_modes_moved():
    record = make_record()
    model, _ = parallel(record)
    twin = dgp.LinearDynamicGP(1, pairs=1).scaled_to(record)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        linear = sample(twin.all_sites(twin.scaling, 1))
    values = starting_point(model, model.prepare(record), Plan("g1", linear, False, 0))
    torch.testing.assert_close(values["g1_log_decay"], linear["g_log_decay"])
    moved = (values["g2_log_decay"] - linear["g_log_decay"]).abs()
    assert 0.0 < float(moved) < 2.0
    ratio = values["g2_input_gain"] / values["g1_input_gain"]
    torch.testing.assert_close(ratio, ratio[0, 0, 0].expand(ratio.shape))
    assert values["g3_log_decay"].shape == (4,)
