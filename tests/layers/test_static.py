"""Static layers as sample sites of Pyro models."""

import math
from typing import Any

import gpytorch
import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.infer import SVI, Predictive, TraceMeanField_ELBO
from pyro.infer.autoguide import AutoNormal

import pyro_dynogp as dgp
from pyro_dynogp.layers.functions import JITTER
from pyro_dynogp.layers.kernels import RESOLVED, SMOOTH
from pyro_dynogp.layers.static import (
    StaticPrior,
    sample_static,
    starting_locations,
    static_gp,
)
from pyro_dynogp.models.feedback_variants import with_feedback
from tests.layers.dense import Dense, close, draw, normal, values

SITES = (
    "f_lengthscale",
    "f_output_scale",
    "f_constant",
    "f_slope",
    "f_center",
    "f_half_width",
    "f_values",
)


def joint(trace):
    trace.compute_log_prob()
    return float(trace.log_prob_sum())


class TestSites:
    @pytest.mark.parametrize("pathwise", [False, True])
    @pytest.mark.parametrize("particles", [None, 3])
    def test_shapes(self, pathwise, particles):
        batch = () if particles is None else (particles,)
        x = normal(5, 2)
        options = {"channels": 2, "outputs": 2, "inducing": 7, "mean": "linear"}
        trace = draw(static_gp, "f", x, particles=particles, pathwise=pathwise, **options)
        shapes = {
            "f_lengthscale": (2,),
            "f_output_scale": (2,),
            "f_constant": (2,),
            "f_slope": (2, 2),
            "f_locations": (7, 2),
            "f_values": (2, 7),
        }
        shapes |= {"f_residual": (2, 5), "f": (5, 2)} if pathwise else {"f": (5, 2)}
        found = values(trace)
        assert list(found) == list(shapes)
        for name, shape in shapes.items():
            node = trace.nodes[name]
            assert node["value"].shape == batch + shape
            assert node["value"].dtype == torch.float64
            assert node["fn"].event_shape == shape
            assert node["fn"].batch_shape == batch
        assert trace.nodes["_RETURN"]["value"].shape == (*batch, 5, 2)
        assert math.isfinite(joint(trace))

    def test_one_channel_one_output(self):
        trace = draw(static_gp, "f", list(range(5)))
        assert trace.nodes["f"]["fn"].event_shape == (5,)
        assert trace.nodes["f_center"]["value"].shape == (1,)
        assert trace.nodes["f_half_width"]["value"].shape == (1,)
        assert trace.nodes["f_values"]["value"].shape == (1, 32)
        assert draw(static_gp, "f", range(5), pathwise=True).nodes["f"]["value"].shape == (5,)

    def test_starting_locations(self):
        grid = torch.linspace(-3.0, 3.0, 32, dtype=torch.float64).unsqueeze(-1)
        assert torch.equal(starting_locations(32, 1), grid)
        for d in (2, 5):
            Z = starting_locations(64, d)
            assert Z.shape == (64, d)
            assert torch.equal(Z, starting_locations(64, d))
            close(Z.mean(0), np.zeros(d), atol=0.1)
            close(Z.std(0), np.ones(d), atol=0.1)
        trace = draw(sample_static, "f", channels=1, outputs=1)
        center, half = (trace.nodes[f"f_{name}"]["value"] for name in ("center", "half_width"))
        close(trace.nodes["_RETURN"]["value"].locations, center + half * grid / 3.0)

    def test_fixed_and_given_locations(self):
        trace = draw(sample_static, "f", channels=1, outputs=1, learn_locations=False, inducing=4)
        assert "f_locations" not in trace.nodes
        assert torch.equal(trace.nodes["_RETURN"]["value"].locations, starting_locations(4, 1))
        trace = draw(sample_static, "f", channels=1, outputs=1, locations=[0.0, 2.0])
        close(trace.nodes["f_locations"]["fn"].mean, [[0.0], [2.0]])
        assert trace.nodes["f_values"]["value"].shape == (1, 2)

    def test_a_linear_mean_starts_as_the_identity(self):
        for outputs, expected in ((2, np.eye(2)), (3, np.zeros((3, 2)))):
            trace = draw(sample_static, "f", channels=2, outputs=outputs, mean="linear")
            close(trace.nodes["f_slope"]["fn"].mean, expected)

    @pytest.mark.parametrize("pathwise", [False, True])
    def test_every_value_is_used(self, pathwise):
        x, y = normal(6), normal(6, seed=1)

        def model():
            f = static_gp("f", x, inducing=4, mean="linear", pathwise=pathwise, support=8)
            pyro.sample("y", dist.Normal(f, 0.5).to_event(1), obs=y)

        trace = draw(model)
        start = values(trace)
        start.pop("y")
        names = (*SITES, "f_residual") if pathwise else (*SITES, "f")
        if pathwise:
            start.pop("f")
        assert set(names) == set(start)
        for name in names:
            changed = {**start, name: start[name] + 0.5 * normal(*start[name].shape).abs()}
            # What follows from the function: the pointwise site's own density, and the data's.
            follows = ("f", "y") if name != "f" else ("y",)
            logs = []
            for data in (start, changed):
                t = pyro.poutine.trace(pyro.condition(model, data=data)).get_trace()
                t.compute_log_prob()
                logs.append(sum(t.nodes[n]["log_prob_sum"] for n in follows).item())
            assert abs(logs[0] - logs[1]) > 1e-3, name


class TestPyro:
    @staticmethod
    def model(x, y=None, pathwise=False):
        f = static_gp("f", x, pathwise=pathwise, inducing=5, support=12)
        sd = pyro.sample("sd", dist.HalfNormal(torch.tensor(1.0, dtype=torch.float64)))
        return pyro.sample("y", dist.Normal(f, sd.unsqueeze(-1)).to_event(1), obs=y)

    def test_condition_and_do_on_the_values(self):
        x, f, y = normal(6), normal(6, seed=1), normal(6, seed=2)
        for effect in (pyro.condition, pyro.do):
            model = effect(self.model, data={"f": f})
            trace = draw(model, x, y)
            sd = trace.nodes["sd"]["value"]
            trace.compute_log_prob()
            expected = dist.Normal(f, sd).log_prob(y).sum()
            close(trace.nodes["y"]["log_prob"], expected)
            own = self.function_of(trace)
            mean, variance = own.moments(x.unsqueeze(-1))
            if effect is pyro.condition:
                assert trace.nodes["f"]["is_observed"]
                floor = JITTER * own.output_scale.square()
                density = dist.Normal(mean[:, 0], (variance[:, 0] + floor).sqrt()).log_prob(f)
                close(trace.nodes["f"]["log_prob"], density.sum())

    @staticmethod
    def function_of(trace):
        data = {n: v for n, v in values(trace).items() if n in SITES}
        with pyro.condition(data=data):
            return sample_static("f", channels=1, outputs=1, inducing=5)

    @pytest.mark.parametrize("pathwise", [False, True])
    @pytest.mark.parametrize("parallel", [False, True])
    def test_predictive(self, pathwise, parallel):
        x = normal(6)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            draws = Predictive(self.model, num_samples=4, parallel=parallel)(x, pathwise=pathwise)
        assert draws["f"].shape == (4, 6)
        posterior = {n: v for n, v in draws.items() if n not in ("f", "y")}
        again = Predictive(self.model, posterior, parallel=parallel)(x, pathwise=pathwise)
        assert again["f"].shape == (4, 6)
        assert torch.equal(again["f"], draws["f"]) == pathwise

    @pytest.mark.parametrize("pathwise", [False, True])
    def test_svi_with_vectorised_particles(self, pathwise):
        x = torch.linspace(-2.0, 2.0, 30, dtype=torch.float64)
        y = x.square() - 1.0 + 0.1 * normal(30)
        with pyro.get_param_store().scope(), torch.random.fork_rng():
            pyro.set_rng_seed(0)
            # A layer in the middle of a model has its residual in the guide; a last one has, given
            # the other sites, the same conditional as in the model.
            others = AutoNormal(pyro.poutine.block(self.model, hide=["f"]), init_scale=0.05)

            def guide(x, y, pathwise):
                given = pyro.condition(self.model, data=others(x, y, pathwise=pathwise))
                if not pathwise:
                    pyro.poutine.block(given, expose=["f"])(x, y, pathwise=pathwise)

            elbo = TraceMeanField_ELBO(
                num_particles=4, vectorize_particles=True, max_plate_nesting=0
            )
            svi = SVI(self.model, guide, pyro.optim.Adam({"lr": 0.05}), elbo)
            losses = [svi.step(x, y, pathwise=pathwise) for _ in range(80)]
        assert np.mean(losses[-10:]) < np.mean(losses[:10]) - 10.0

    def test_nuts_potential_has_the_gradient_of_its_finite_differences(self):
        x, y = normal(6), normal(6, seed=1)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            initial, potential, *_ = pyro.infer.mcmc.util.initialize_model(
                self.model, (x, y), {"pathwise": True}
            )
        names = list(initial)
        point = [initial[n].detach().double().requires_grad_() for n in names]

        def energy(*p):
            return potential(dict(zip(names, p, strict=True)))

        options = {"atol": 1e-4, "rtol": 1e-3, "check_undefined_grad": False}
        assert torch.autograd.gradcheck(energy, point, **options)


class TestPathwise:
    def test_equal_inputs_have_equal_values(self):
        x = torch.tensor([0.3, -1.0, 0.3, 2.0, -1.0], dtype=torch.float64)
        f = draw(static_gp, "f", x, pathwise=True).nodes["f"]["value"]
        close(f[[0, 1]], f[[2, 4]], atol=1e-12)
        independent = draw(static_gp, "f", x, inducing=3).nodes["f"]["value"]
        assert abs(float(independent[0] - independent[2])) > 1e-3

    def test_moments_by_monte_carlo(self):
        particles, x = 20_000, normal(5)
        given = {
            "f_lengthscale": torch.tensor([0.6], dtype=torch.float64),
            "f_output_scale": torch.tensor([1.5], dtype=torch.float64),
            "f_constant": torch.tensor([0.3], dtype=torch.float64),
            "f_values": normal(1, 3, seed=1),
        }
        options = {"locations": [-1.0, 0.0, 1.0], "learn_locations": False}
        with pyro.condition(data=given):
            trace = draw(
                static_gp, "f", x, particles=particles, pathwise=True, support=64, **options
            )
            f = sample_static("f", channels=1, outputs=1, **options)
        dense = Dense(f)
        at = x.unsqueeze(-1).numpy()
        draws = trace.nodes["f"]["value"].numpy()
        C = 1.5**2 * dense.covariance(at, at)
        error = draws.mean(0) - dense.mean(at)[:, 0]
        # The dropped variance between 64 support points is below 1e-4 here.
        assert (np.abs(error) < 6.0 * np.sqrt(np.diag(C) / particles)).all()
        sd = np.sqrt((np.outer(np.diag(C), np.diag(C)) + C**2) / particles)
        assert (np.abs(np.cov(draws.T) - C) < 6.0 * sd + 1e-4).all()

    def test_support_covers_each_particles_own_range(self):
        x = torch.stack([normal(50), 10.0 + 0.1 * normal(50)])
        trace = draw(static_gp, "f", x, particles=2, pathwise=True, support=40)
        found = values(trace)
        assert found["f_residual"].shape == (2, 1, 40)
        assert found["f"].shape == (2, 50)
        for i in range(2):
            data = {n: v[i] for n, v in found.items() if n != "f"}
            alone = pyro.condition(static_gp, data=data)("f", x[i], pathwise=True, support=40)
            close(found["f"][i], alone, atol=1e-8)

    def test_support_moves_without_gradient(self):
        x = normal(10)
        data = values(draw(static_gp, "f", x, pathwise=True, support=16))
        data.pop("f")
        layer = pyro.condition(static_gp, data=data)
        margin = 0.02 * (x.max() - x.min())
        ends = float(x.min() - margin), float(x.max() + margin)
        grid = torch.linspace(*ends, 16, dtype=torch.float64)
        slopes = []
        for support in (16, grid):
            at = x.clone().requires_grad_()
            layer("f", at, pathwise=True, support=support).square().sum().backward()
            slopes.append(at.grad)
        close(slopes[0], slopes[1], atol=1e-6, rtol=1e-6)

    def test_given_support_is_the_same_function_along_another_path(self):
        grid = torch.linspace(-2.0, 2.0, 30, dtype=torch.float64)
        x = normal(10).clamp(-2.0, 2.0)
        trace = draw(static_gp, "f", x, pathwise=True, support=grid)
        data = {n: v for n, v in values(trace).items() if n != "f"}
        longer = torch.cat([x, normal(7, seed=1)])
        again = pyro.condition(static_gp, data=data)("f", longer, pathwise=True, support=grid)
        close(again[:10], trace.nodes["f"]["value"], atol=1e-10)

    def test_several_channels_take_samples_of_the_path(self):
        x = normal(100, 2)
        for support, K in ((30, 30), (500, 100)):
            trace = draw(static_gp, "f", x, channels=2, pathwise=True, support=support)
            assert trace.nodes["f_residual"]["value"].shape == (1, K)

    def test_constant_path(self):
        trace = draw(static_gp, "f", torch.ones(5), pathwise=True, support=8)
        f = trace.nodes["f"]["value"]
        close(f, f[:1].expand(5))


class TestErrors:
    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"outputs": 0}, "outputs: expected a whole number >= 1, got 0"),
            ({"channels": 0}, "channels: expected a whole number"),
            ({"inducing": 2.0}, "inducing: expected a whole number >= 1, got 2.0"),
            ({"mean": "zero"}, "mean: expected 'constant' or 'linear', got 'zero'"),
            ({"kernel": "rbf"}, "kernel: expected a gpytorch kernel"),
            ({"locations": [[0.0, 1.0]]}, r"locations: .*shape \(count, 1\), got shape \(1, 2\)"),
            ({"locations": []}, r"locations: expected shape"),
            ({"locations": [math.nan]}, "locations: expected finite numbers"),
            ({"pathwise": True, "support": 0}, "support: expected a whole number"),
            ({"pathwise": True, "support": True}, "support: expected a whole number"),
            ({"pathwise": True, "support": [[0.0, 1.0]]}, r"support: expected shape \(count, 1\)"),
            ({"channels": 3}, r"x: expected shape \(..., n, 3\), got shape \(5,\)"),
        ],
    )
    def test_options(self, options, message):
        with pytest.raises(ValueError, match=message):
            static_gp("f", normal(5), **options)

    @pytest.mark.parametrize(
        ("x", "message"),
        [
            ([1.0, math.nan], "x: expected finite numbers, got NaN or infinity"),
            ([1.0, math.inf], "x: expected finite numbers"),
            (1.0, r"x: expected shape \(..., n\), got shape \(\)"),
        ],
    )
    def test_inputs(self, x, message):
        with pytest.raises(ValueError, match=message):
            static_gp("f", x)


ONE_CHANNEL: Any = {"channels": 1, "outputs": 1, "inducing": 9, "smoothness": SMOOTH}


class TestLeastLengthscale:
    """Inducing values do not tell what varies between their locations."""

    def values(self, lengthscale, prior):
        found = {site.name: site.typical() for site in prior.sites()}
        one = torch.ones(1, dtype=torch.float64)
        return {**found, "f_lengthscale": lengthscale * one, "f_half_width": 4.0 * one}

    @pytest.mark.parametrize("lengthscale", [1e-6, 0.3, 5.0])
    def test_root_of_squares_with_the_distance_of_locations(self, lengthscale):
        prior = StaticPrior("f", least_lengthscale=1.7, **ONE_CHANNEL)
        function = prior.function(self.values(lengthscale, prior))
        expected = math.sqrt(lengthscale**2 + 1.7**2)  # locations are one apart
        assert function.kernel.radial is not None
        assert float(function.kernel.radial[1]) == pytest.approx(expected, rel=1e-12)  # rounding
        x = 0.25 + torch.arange(-4.0, 4.0, dtype=torch.float64).unsqueeze(-1)
        other = StaticPrior("f", **ONE_CHANNEL)
        same = other.function(self.values(expected, other))
        close(function.mean(x), same.mean(x), 1e-12)

    @pytest.mark.parametrize("at", [0.0, 0.1, 0.25, 0.5])
    def test_little_is_left_open_between_locations(self, at):
        """Of a scale of one: 8 % at most however short the site's lengthscale is."""
        prior = StaticPrior("f", least_lengthscale=RESOLVED, **ONE_CHANNEL)
        x = torch.tensor([[at], [2.0 + at]], dtype=torch.float64)
        left = prior.function(self.values(1e-6, prior)).moments(x)[1]
        assert float(left.max()) < 0.08**2
        free = StaticPrior("f", **ONE_CHANNEL)
        if at == 0.5:
            assert float(free.function(self.values(0.1, free)).moments(x)[1].min()) > 0.99

    @pytest.mark.parametrize(
        "options",
        [{"least_lengthscale": 0.0}, {"locations": np.arange(9.0)}, {"learn_locations": False}],
    )
    def test_other_grids_have_none(self, options):
        prior = StaticPrior("f", **{"least_lengthscale": 2.0, **ONE_CHANNEL, **options})
        assert float(prior.lengthscale(self.values(0.1, prior))) == 0.1

    def test_another_kernel_has_none(self):
        kernel = gpytorch.kernels.MaternKernel(2.5)
        prior = StaticPrior("f", 1, 1, kernel=kernel, least_lengthscale=2.0)
        assert prior.lengthscale({site.name: site.typical() for site in prior.sites()}) is None

    def test_functions_in_feedback_have_one(self):
        kernel = gpytorch.kernels.MaternKernel(2.5)
        loop = with_feedback(dgp.LinearDynamicGP(1), hidden=True)
        for model, least in (
            (dgp.NonlinearFeedback(1, hidden=1), RESOLVED),
            (dgp.NonlinearFeedback(1, hidden=1, kernel=kernel), 0.0),
            (loop, RESOLVED),
            (dgp.Wiener(1), 0.0),
        ):
            functions = [x for x in model.layers if isinstance(x, dgp.Static)]
            assert {x.least_lengthscale for x in functions} == {least}
            wire = next(w for w in model.wires if isinstance(w.layer, dgp.Static))
            scaled = model.scaled_to(dgp.datasets.load("gas_furnace").train)
            assert scaled.static_prior(wire, wire.layer).least_lengthscale == least
