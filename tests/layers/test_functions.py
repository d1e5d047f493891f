"""Static functions against dense algebra, GPyTorch's SVGP and exact conditional moments."""

import math
from dataclasses import replace

import gpytorch
import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from gpytorch.kernels import LinearKernel, MaternKernel, PeriodicKernel, RBFKernel, ScaleKernel
from pyro.infer import Trace_ELBO, TraceMeanField_ELBO

from pyro_dynogp.layers.functions import JITTER, LARGER_JITTER, StaticFunction, _cholesky
from pyro_dynogp.layers.kernels import SampledKernel, sample_kernel
from pyro_dynogp.layers.static import starting_locations, static_gp
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError
from tests.layers.dense import Dense, close, function, normal


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

    def test_limits_are_those_of_the_prior_mean(self, channels, outputs, mean):
        """The function itself may go beyond them: what the data say of it comes on top."""
        free = function(channels=channels, outputs=outputs, mean=mean)
        f = replace(free, limits=(-0.2, 0.4))
        x = normal(9, channels)
        straight = Dense(free).prior_mean(x.numpy())
        close(f.prior_mean(x), np.clip(straight, -0.2, 0.4))
        close(f.mean(x) - f.prior_mean(x), free.mean(x) - free.prior_mean(x))
        close(f.variance(x), free.variance(x))
        close(f.mean(f.locations), f.inducing_values.mT, atol=1e-6)
        nowhere = replace(free, limits=(-math.inf, 0.4))
        close(nowhere.prior_mean(x), np.minimum(straight, 0.4))

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


class TestErrors:
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
