"""Static layers against dense algebra, GPyTorch's SVGP and exact conditional moments."""

import math

import gpytorch
import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from gpytorch.kernels import LinearKernel, MaternKernel, PeriodicKernel, RBFKernel, ScaleKernel
from pyro.infer import SVI, Predictive, Trace_ELBO, TraceMeanField_ELBO
from pyro.infer.autoguide import AutoNormal

from pyro_dynogp.layers.kernels import SampledKernel, sample_kernel
from pyro_dynogp.layers.static import (
    JITTER,
    LARGER_JITTER,
    StaticFunction,
    _cholesky,
    sample_static,
    starting_locations,
    static_gp,
)
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError

SITES = (
    "f_lengthscale",
    "f_output_scale",
    "f_constant",
    "f_slope",
    "f_center",
    "f_half_width",
    "f_values",
)


def close(actual, expected, atol=1e-9, rtol=1e-9):
    expected = torch.as_tensor(np.asarray(expected), dtype=torch.float64)
    torch.testing.assert_close(actual.detach(), expected, atol=atol, rtol=rtol)


def normal(*shape, seed=0):
    return torch.as_tensor(np.random.default_rng(seed).standard_normal(shape))


def draw(model, *args, seed=0, particles=None, **kwargs):
    """Trace of a model under a plate of particles."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)

        def whole():
            if particles is None:
                return model(*args, **kwargs)
            with pyro.plate("particles", particles):
                return model(*args, **kwargs)

        return pyro.poutine.trace(whole).get_trace()


def function(seed=0, particles=None, **kwargs):
    options = {"channels": 1, "outputs": 1, "inducing": 6} | kwargs
    trace = draw(sample_static, "f", seed=seed, particles=particles, **options)
    return trace.nodes["_RETURN"]["value"]


def values(trace):
    """Values of the sites of a trace, without its plates."""
    return {
        name: node["value"]
        for name, node in trace.nodes.items()
        if node["type"] == "sample" and name != "particles"
    }


def matern32(x, z, lengthscale):
    r = np.sqrt((((x[:, None] - z[None]) / lengthscale) ** 2).sum(-1))
    return (1.0 + math.sqrt(3.0) * r) * np.exp(-math.sqrt(3.0) * r)


class Dense:
    """The conditional of a function with the default kernel, by inverses."""

    def __init__(self, f):
        self.f = f
        self.Z, self.v = f.locations.numpy(), f.whitened.numpy()
        self.scale, self.lengthscale = f.output_scale.numpy(), f.kernel.radial[1].numpy()
        self.K = self.k(self.Z, self.Z) + JITTER * np.eye(len(self.Z))
        self.inverse = np.linalg.inv(self.K)

    def k(self, x, z):
        return matern32(x, z, self.lengthscale)

    def prior_mean(self, x):
        slope = np.zeros((self.f.outputs, self.f.channels))
        slope = slope if self.f.slope is None else self.f.slope.numpy()
        return self.f.constant.numpy() + x @ slope.T

    @property
    def inducing_values(self):
        return self.prior_mean(self.Z).T + self.scale[:, None] * (
            self.v @ np.linalg.cholesky(self.K).T
        )

    def mean(self, x):
        residual = self.inducing_values - self.prior_mean(self.Z).T
        return self.prior_mean(x) + self.k(x, self.Z) @ self.inverse @ residual.T

    def covariance(self, x, z):
        """R(x, z), of a function of unit scale."""
        return self.k(x, z) - self.k(x, self.Z) @ self.inverse @ self.k(self.Z, z)


@pytest.mark.parametrize("mean", ["constant", "linear"])
@pytest.mark.parametrize(("channels", "outputs"), [(1, 1), (1, 3), (2, 1), (2, 2)])
class TestConditional:
    def test_moments(self, channels, outputs, mean):
        f = function(channels=channels, outputs=outputs, mean=mean)
        dense = Dense(f)
        x = normal(9, channels)
        expected = dense.mean(x.numpy())
        variance = np.diag(dense.covariance(x.numpy(), x.numpy()))[:, None] * dense.scale**2
        close(f.inducing_values, dense.inducing_values)
        close(f.prior_mean(x), dense.prior_mean(x.numpy()))
        close(f.mean(x), expected)
        close(f.variance(x), variance)
        close(f.moments(x)[0], expected)
        close(f.moments(x)[1], variance)
        linear = f.kernel(x, f.locations) @ f.weights.mT
        close(f.prior_mean(x) + linear, expected)

    def test_at_the_locations_it_is_the_inducing_values(self, channels, outputs, mean):
        f = function(channels=channels, outputs=outputs, mean=mean)
        close(f.mean(f.locations), f.inducing_values.mT, atol=1e-6)
        variance = f.variance(f.locations)
        assert bool((variance >= 0.0).all())
        assert float((variance / f.output_scale.square()).max()) < 3.0 * JITTER

    def test_path_is_a_draw_of_the_conditional(self, channels, outputs, mean):
        # Linear in its innovations: mean and covariance are exact, without a Monte Carlo error.
        f = function(channels=channels, outputs=outputs, mean=mean)
        dense = Dense(f)
        support = normal(20, channels, seed=1)
        x = support[[3, 3, 0, 17, 8, 11]]
        zero = torch.zeros(outputs, 20, dtype=torch.float64)
        close(f.path(x, zero, support), dense.mean(x.numpy()))
        J = torch.autograd.functional.jacobian(lambda e: f.path(x, e, support), zero)
        R = dense.covariance(x.numpy(), x.numpy())
        expected = np.zeros((6, outputs, 6, outputs))
        for a in range(outputs):
            expected[:, a, :, a] = dense.scale[a] ** 2 * R
        close(torch.einsum("naek,mbek->namb", J, J), expected, atol=1e-7)

    def test_path_between_support_points(self, channels, outputs, mean):
        f = function(channels=channels, outputs=outputs, mean=mean)
        dense = Dense(f)
        x = normal(15, channels).clamp(-1.5, 1.5)
        share = []
        for K in (4, 40, 400):
            if channels == 1:
                support = torch.linspace(-1.6, 1.6, K, dtype=torch.float64).unsqueeze(-1)
            else:
                support = 1.7 * starting_locations(K, channels) / 2.0
            zero = torch.zeros(outputs, K, dtype=torch.float64)
            J = torch.autograd.functional.jacobian(lambda e, s=support: f.path(x, e, s), zero)
            drawn = torch.einsum("naek,maek->anm", J, J).numpy()
            missing = dense.scale[:, None, None] ** 2 * dense.covariance(*[x.numpy()] * 2) - drawn
            # What is dropped is a variance, and ever less of it.
            eigenvalues = np.linalg.eigvalsh(missing)
            assert eigenvalues.min() > -1e-7
            share.append((eigenvalues / dense.scale[:, None] ** 2).max())
        assert share[2] < share[1] < share[0]
        assert share[2] < (1e-3 if channels == 1 else 0.1)


def test_outputs_are_separate_functions_of_one_kernel():
    f = function(outputs=3, mean="linear", channels=2)
    x, e, support = normal(7, 2), normal(3, 10, seed=1), normal(10, 2, seed=2)
    for a in range(3):
        one = StaticFunction(
            f.kernel,
            f.locations,
            f.whitened[a : a + 1],
            f.output_scale[a : a + 1],
            f.constant[a : a + 1],
            f.slope[a : a + 1],
        )
        close(f.mean(x)[:, a], one.mean(x)[:, 0])
        close(f.variance(x)[:, a], one.variance(x)[:, 0])
        path = one.path(x, e[a : a + 1], support)[:, 0]
        close(f.path(x, e, support)[:, a], path)


KERNELS = {
    "default": lambda: None,
    "rbf": lambda: RBFKernel(ard_num_dims=2),
    "matern52": lambda: MaternKernel(2.5, ard_num_dims=2),
    "sum": lambda: ScaleKernel(RBFKernel()) + ScaleKernel(LinearKernel()),
    "periodic": lambda: PeriodicKernel(),
}


@pytest.mark.parametrize("name", KERNELS)
def test_batch_is_a_loop(name):
    kernel = KERNELS[name]()
    options = {"channels": 2, "outputs": 2, "mean": "linear", "kernel": kernel}
    f = function(particles=3, **options)
    assert f.batch_shape == (3,)
    x, e, support = normal(3, 7, 2), normal(3, 2, 9, seed=1), normal(3, 9, 2, seed=2)
    own = {n: f.kernel.kernel.get_parameter(n).dim() for n in f.kernel.values}
    assert all(v.shape[: v.dim() - own[n]] == (3,) for n, v in f.kernel.values.items())
    for i in range(3):
        one = StaticFunction(
            SampledKernel(f.kernel.kernel, {n: v[i] for n, v in f.kernel.values.items()}, 2),
            f.locations[i],
            f.whitened[i],
            f.output_scale[i],
            f.constant[i],
            f.slope[i],
        )
        assert one.batch_shape == ()
        close(f.mean(x)[i], one.mean(x[i]))
        close(f.mean(x[0])[i], one.mean(x[0]))
        close(f.variance(x)[i], one.variance(x[i]))
        close(f.inducing_values[i], one.inducing_values)
        close(f.path(x, e, support)[i], one.path(x[i], e[i], support[i]), atol=1e-7)
        close(f.path(x[0], e[0], support[0])[i], one.path(x[0], e[0], support[0]), atol=1e-7)


def test_shapes_of_attributes_only_need_to_broadcast():
    f = function(outputs=2)
    many = StaticFunction(
        f.kernel,
        f.locations,
        normal(5, 1, 2, 6),
        f.output_scale,
        normal(3, 2, seed=1),
        normal(2, 1, seed=2),
    )
    assert many.batch_shape == (5, 3)
    x = normal(4, 1, seed=3)
    mean, variance = many.moments(x)
    assert mean.shape == variance.shape == (5, 3, 4, 2)
    assert many.path(x, normal(2, 8), normal(8, 1)).shape == (5, 3, 4, 2)
    table = many.table(-1.0, 1.0, 4)
    assert [t.shape for t in table] == [(5, 3, 4), (5, 3, 2, 4), (5, 3, 2, 4)]


class TestTable:
    def test_values(self):
        f = function(outputs=2, particles=3, mean="linear")
        low, high = torch.tensor([-1.0, -2.0, 0.0]), torch.tensor([1.0, 0.0, 4.0])
        table = f.table(low, high.double().requires_grad_(), 5)
        assert not table.grid.requires_grad
        close(table.grid, np.linspace(low.numpy(), high.numpy(), 5).T)
        x = table.grid.unsqueeze(-1)
        close(table.mean, f.mean(x).mT)
        close(table.variance, f.variance(x).mT)

    def test_gradients_flow_through_it(self):
        f = function()
        v = f.whitened.clone().requires_grad_()
        g = StaticFunction(f.kernel, f.locations, v, f.output_scale, f.constant)
        g.table(-1.0, 1.0, 5).mean.sum().backward()
        assert bool((v.grad != 0.0).any())

    def test_errors(self):
        with pytest.raises(ValueError, match="a function of one channel, got 2"):
            function(channels=2).table(-1.0, 1.0, 5)
        with pytest.raises(ValueError, match="count: expected at least two points, got 1"):
            function().table(-1.0, 1.0, 1)
        with pytest.raises(ValueError, match="high: expected above low"):
            function().table(1.0, 1.0, 5)
        with pytest.raises(ValueError, match="high: expected above low"):
            function().table(math.nan, 1.0, 5)


@pytest.mark.parametrize("name", ["default", "sum"])
def test_gradients(name):
    f = function(channels=2, outputs=2, inducing=3, mean="linear", kernel=KERNELS[name]())
    names = list(f.kernel.values)

    def evaluate(x, residual, support, Z, v, scale, constant, slope, *hyper):
        kernel = SampledKernel(f.kernel.kernel, dict(zip(names, hyper, strict=True)), 2)
        g = StaticFunction(kernel, Z, v, scale, constant, slope)
        return *g.moments(x), g.inducing_values, g.weights, g.path(x, residual, support)

    arguments = (
        normal(4, 2, seed=3),
        normal(2, 3, seed=4),
        normal(3, 2, seed=5),
        f.locations,
        f.whitened,
        f.output_scale,
        f.constant,
        f.slope,
        *f.kernel.values.values(),
    )
    arguments = tuple(a.detach().clone().requires_grad_() for a in arguments)
    assert torch.autograd.gradcheck(evaluate, arguments, atol=1e-5, rtol=1e-3)


class TestCholesky:
    def test_coincident_locations(self):
        f = function(locations=[0.0, 0.0, 0.0, 1.0], learn_locations=False)
        x = normal(5, 1)
        mean, variance = f.moments(x)
        assert bool(mean.isfinite().all())
        assert bool(variance.isfinite().all())
        # Given v, three values at one place say no more than one does.
        close(f.inducing_values[0, :3], f.inducing_values[0, :1].expand(3), atol=3e-3)
        draws = f.path(torch.zeros(4, 1, dtype=torch.float64), normal(1, 5), torch.zeros(5, 1))
        assert float(draws.std()) < 1e-9

    def test_an_element_that_fails_gets_more_jitter_alone(self):
        Q, _ = torch.linalg.qr(normal(4, 4))
        bad = Q @ torch.diag(torch.tensor([1.0, 1.0, 1.0, -1e-7], dtype=torch.float64)) @ Q.mT
        good = Q @ torch.diag(torch.tensor([1.0, 1.0, 1.0, 0.5], dtype=torch.float64)) @ Q.mT
        level = torch.tensor([1.0, 2.0], dtype=torch.float64)
        root = _cholesky(torch.stack([bad, good]), level, "it")
        eye = torch.eye(4, dtype=torch.float64)
        close(root @ root.mT, torch.stack([bad + LARGER_JITTER * eye, good + 2.0 * JITTER * eye]))
        assert torch.equal(root[1], _cholesky(good, level[1], "it"))

    @pytest.mark.parametrize(("value", "entries"), [(math.nan, "not finite"), (None, "finite")])
    def test_error_names_the_layer(self, value, entries):
        kernel = sample_kernel("k", None, 1)
        if value is None:  # a covariance that is none
            kernel = sample_kernel("k", ScaleKernel(RBFKernel()), 1)
            minus = torch.tensor(-1.0, dtype=torch.float64)
            kernel = SampledKernel(kernel.kernel, {**kernel.values, "raw_outputscale": minus}, 1)
        else:
            nan = torch.full((1, 1), value, dtype=torch.float64)
            kernel = SampledKernel(kernel.kernel, {"raw_lengthscale": nan}, 1)
        f = StaticFunction(kernel, normal(3, 1), normal(1, 3), normal(1), normal(1), name="valve")
        message = rf"^valve: the covariance of the inducing.*1e-06.*entries are {entries}\)"
        with pytest.raises(NotPositiveDefiniteError, match=message):
            f.mean(normal(3, 1))


def gpytorch_model(kernel, Z, v, root, constant, variance):
    """GPyTorch's whitened SVGP with q(v) = N(v, root root'), its jitter that of the variance."""
    jitter = JITTER * float(variance)

    class Model(gpytorch.models.ApproximateGP):
        def __init__(self):
            q = gpytorch.variational.CholeskyVariationalDistribution(len(Z))
            super().__init__(
                gpytorch.variational.VariationalStrategy(
                    self, Z, q, learn_inducing_locations=False, jitter_val=jitter
                )
            )
            self.mean_module = gpytorch.means.ConstantMean()
            self.covar_module = kernel

        def forward(self, x):
            return gpytorch.distributions.MultivariateNormal(
                self.mean_module(x), self.covar_module(x)
            )

    model = Model().double()
    model.mean_module.initialize(constant=float(constant))
    # Otherwise the first call sets q to the prior.
    model.variational_strategy.variational_params_initialized.fill_(1)
    q = model.variational_strategy._variational_distribution
    q.variational_mean.data = v.clone()
    q.chol_variational_covar.data = root.clone()
    return model


GPYTORCH = {
    "matern32": (lambda: None, lambda: MaternKernel(1.5)),
    "matern52": (lambda: MaternKernel(2.5),) * 2,
    "rbf": (lambda: RBFKernel(),) * 2,
    "periodic": (lambda: PeriodicKernel(),) * 2,
}


@pytest.mark.parametrize("name", GPYTORCH)
def test_predictions_are_those_of_gpytorch(name):
    ours, theirs = GPYTORCH[name]
    shape = (1,) if name == "matern32" else (1, 1)
    with pyro.condition(data={"f_lengthscale": torch.full(shape, 0.7, dtype=torch.float64)}):
        f = function(kernel=ours(), inducing=8)
    base = theirs().double()
    base.initialize(**{n.removeprefix("raw_"): v.detach() for n, v in f.kernel.values.items()})
    kernel = ScaleKernel(base).double()
    kernel.outputscale = f.output_scale.square()
    zero = torch.zeros(8, 8, dtype=torch.float64)
    model = gpytorch_model(kernel, f.locations, f.whitened[0], zero, f.constant, f.output_scale**2)
    model.eval()
    x = normal(11, 1)
    with torch.no_grad():
        predicted = model(x)
    # They add jitter to the variance of the values too.
    close(f.mean(x)[:, 0], predicted.mean, atol=1e-6)
    close(f.variance(x)[:, 0], predicted.variance, atol=2.0 * JITTER * float(f.output_scale**2))


NOISE_SD = 0.4


class Problem:
    """A static layer with Gaussian noise, all but the function given."""

    def __init__(self, full):
        self.full = full
        self.x = torch.linspace(-2.0, 2.0, 25, dtype=torch.float64)
        self.y = torch.sin(1.5 * self.x) + NOISE_SD * normal(25)
        tensor = torch.tensor
        self.given = {
            "f_lengthscale": tensor([0.8], dtype=torch.float64),
            "f_output_scale": tensor([1.2], dtype=torch.float64),
            "f_constant": tensor([0.3], dtype=torch.float64),
        }
        self.Z = torch.linspace(-2.0, 2.0, 6, dtype=torch.float64)
        # Not the optimum: the bound has to agree anywhere.
        self.mean = 0.7 * normal(6, seed=1)
        self.root = 0.5 * torch.eye(6, dtype=torch.float64)
        if full:
            self.root = self.root + torch.tril(0.2 * normal(6, 6, seed=2))

    def layer(self, **kwargs):
        # Not only conditioned on but hidden, for their densities are no part of the bound.
        with pyro.poutine.block(hide=list(self.given)), pyro.condition(data=self.given):
            return static_gp("f", self.x, locations=self.Z, learn_locations=False, **kwargs)

    def model(self):
        f = self.layer()
        pyro.sample("y", dist.Normal(f, NOISE_SD).to_event(1), obs=self.y)

    def guide(self):
        mean = self.mean.unsqueeze(0)
        if self.full:
            q = dist.MultivariateNormal(mean, scale_tril=self.root).to_event(1)
        else:  # whose divergence from the prior Pyro knows in closed form
            q = dist.Normal(mean, self.root.diagonal()).to_event(2)
        v = pyro.sample("f_values", q)
        # The layer's own sites but f are the model's affair.
        with pyro.poutine.block(expose=["f"]), pyro.condition(data={"f_values": v}):
            self.layer()

    def gpytorch_bound(self):
        kernel = ScaleKernel(MaternKernel(1.5)).double()
        kernel.base_kernel.lengthscale = 0.8
        kernel.outputscale = 1.44
        model = gpytorch_model(kernel, self.Z.unsqueeze(-1), self.mean, self.root, 0.3, 1.44)
        likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
        likelihood.noise = NOISE_SD**2
        bound = gpytorch.mlls.VariationalELBO(likelihood, model, num_data=25)
        model.train()
        with torch.no_grad():
            return float(bound(model(self.x), self.y)) * 25


@pytest.mark.parametrize(("elbo", "full"), [(Trace_ELBO, True), (TraceMeanField_ELBO, False)])
def test_bound_is_that_of_gpytorch(elbo, full):
    problem = Problem(full)
    expected = problem.gpytorch_bound()
    loss = elbo(num_particles=16_000, vectorize_particles=True, max_plate_nesting=0)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        bounds = np.array([-loss.loss(problem.model, problem.guide) for _ in range(20)])
    error = bounds.std(ddof=1) / math.sqrt(len(bounds))
    assert error < 0.3
    assert abs(bounds.mean() - expected) < 4.0 * error


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
            # A layer in the middle of a model has its residual in the guide, a last one its values.
            guide = AutoNormal(self.model, init_scale=0.05)
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
            ({"outputs": 0}, "outputs: expected a whole number of at least one, got 0"),
            ({"channels": 0}, "channels: expected a whole number"),
            ({"inducing": 2.0}, "inducing: expected a whole number of at least one, got 2.0"),
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

    @pytest.mark.parametrize(
        ("field", "shape", "expected"),
        [
            ("locations", (6, 2), r"\(..., 6, 1\)"),
            ("whitened", (1, 5), r"\(..., 1, 6\)"),
            ("output_scale", (2,), r"\(..., 1\)"),
            ("constant", (), r"\(..., 1\)"),
            ("slope", (1, 2), r"\(..., 1, 1\)"),
        ],
    )
    def test_parts_that_do_not_fit(self, field, shape, expected):
        f = function(mean="linear")
        names = ("kernel", "locations", "whitened", "output_scale", "constant", "slope")
        parts = {n: getattr(f, n) for n in names} | {field: normal(*shape)}
        with pytest.raises(ValueError, match=rf"{field}: expected shape {expected}"):
            StaticFunction(**parts)

    def test_points(self):
        f = function()
        with pytest.raises(ValueError, match=r"x: expected shape .*n, 1\), got shape \(5, 2\)"):
            f.mean(normal(5, 2))
        with pytest.raises(ValueError, match=r"support: expected shape"):
            f.path(normal(5, 1), normal(1, 4), normal(4))
        with pytest.raises(ValueError, match=r"residual: expected shape \(..., 1, 4\)"):
            f.path(normal(5, 1), normal(1, 5), normal(4, 1))
