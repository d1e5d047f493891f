"""SampledKernel against GPyTorch's own evaluation, one batch element at a time."""

import copy

import gpytorch
import pyro
import pyro.distributions as dist
import pytest
import torch
from gpytorch.constraints import GreaterThan, Interval, LessThan
from gpytorch.kernels import (
    ConstantKernel,
    CosineKernel,
    Kernel,
    LinearKernel,
    MaternKernel,
    PeriodicKernel,
    PolynomialKernel,
    RBFKernel,
    RQKernel,
    ScaleKernel,
)
from gpytorch.priors import (
    GammaPrior,
    HalfCauchyPrior,
    HalfNormalPrior,
    LogNormalPrior,
    NormalPrior,
    SmoothedBoxPrior,
    UniformPrior,
)
from torch.distributions import constraints

from pyro_dynogp.layers.hyperpriors import hyperprior
from pyro_dynogp.layers.kernels import KernelPrior, SampledKernel, sample_kernel


class TentKernel(Kernel):
    """A user's kernel, which knows nothing of batches: max(0, 1 - |x - x'| width)."""

    def __init__(self):
        super().__init__()
        self.register_parameter("width", torch.nn.Parameter(torch.tensor(0.4)))

    def forward(self, x1, x2, diag=False, **params):
        assert x1.dim() == 2
        distance = (x1[:, None] - x2[None]).norm(dim=-1)
        return (1.0 - distance * self.width).clamp_min(0.0)


KERNELS = {
    "rbf": lambda: RBFKernel(),
    "rbf ard": lambda: RBFKernel(ard_num_dims=2),
    "matern12": lambda: MaternKernel(0.5),
    "matern32": lambda: MaternKernel(1.5, ard_num_dims=2),
    "matern52": lambda: MaternKernel(2.5, ard_num_dims=2),
    "scaled": lambda: ScaleKernel(MaternKernel(2.5, ard_num_dims=2)),
    "sum": lambda: ScaleKernel(RBFKernel()) + ScaleKernel(LinearKernel()),
    "linear ard": lambda: LinearKernel(ard_num_dims=2),
    "periodic": lambda: PeriodicKernel(ard_num_dims=2),
    "cosine": lambda: CosineKernel(),
    "rational": lambda: RQKernel(ard_num_dims=2),
    "one channel": lambda: ScaleKernel(RBFKernel(active_dims=[1])),
    "product": lambda: ScaleKernel(PeriodicKernel() * RBFKernel(active_dims=[0])),
    "nested": lambda: (RBFKernel() + CosineKernel()) * ScaleKernel(MaternKernel(0.5)) + RQKernel(),
    "polynomial": lambda: PolynomialKernel(2),
    "constant": lambda: ConstantKernel() + RBFKernel(),
    "own": lambda: ScaleKernel(TentKernel()),
}
# What the plain formulas recognise: function of the distance, and whether a scale is above it.
RADIAL = {
    "rbf": ("rbf", False),
    "rbf ard": ("rbf", False),
    "matern12": ("matern12", False),
    "matern32": ("matern32", False),
    "matern52": ("matern52", False),
    "scaled": ("matern52", True),
}


def points(*shape, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return torch.randn(*shape, dtype=torch.float64)


def sampled(kernel, particles=None, seed=0, channels=2):
    """Trace of the sites and the kernel that they give."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)

        def model():
            if particles is None:
                return sample_kernel("k", kernel, channels)
            with pyro.plate("particles", particles):
                return sample_kernel("k", kernel, channels)

        trace = pyro.poutine.trace(model).get_trace()
    return trace, trace.nodes["_RETURN"]["value"]


def with_values(kernel, values, index=()):
    """GPyTorch's kernel with the parameters set through its own constraints."""
    kernel = copy.deepcopy(kernel).double()
    kernel.initialize(**{name: value[index] for name, value in values.items()})
    return kernel


def plain(values):
    return {name.replace("raw_", ""): value.detach() for name, value in values.items()}


@pytest.mark.parametrize("name", KERNELS)
class TestAgainstGPyTorch:
    def test_one(self, name):
        kernel = KERNELS[name]()
        _, ours = sampled(kernel)
        theirs = with_values(kernel, plain(ours.values))
        x, z = points(5, 2), points(4, 2, seed=1)
        torch.testing.assert_close(ours(x, z), theirs(x, z).to_dense(), atol=1e-10, rtol=1e-10)
        # Their distance of a point to itself is the square root of a rounding error.
        torch.testing.assert_close(ours(x, x), theirs(x, x).to_dense(), atol=1e-7, rtol=0)
        diagonal = theirs(x, x).to_dense().diagonal(dim1=-1, dim2=-2)
        torch.testing.assert_close(ours.diagonal(x), diagonal, atol=1e-7, rtol=0)

    @pytest.mark.parametrize("batched", [True, False])
    def test_particles_are_a_loop(self, name, batched):
        kernel = KERNELS[name]()
        _, ours = sampled(kernel, particles=3)
        x, z = points(3, 5, 2), points(4, 2, seed=1)
        x = x if batched else x[0]
        K, variance = ours(x, z), ours.diagonal(x)
        assert ours.batch_shape == (3,)
        assert K.shape == (3, 5, 4)
        assert variance.shape == (3, 5)
        for i in range(3):
            theirs = with_values(kernel, plain(ours.values), i)
            one = x[i] if batched else x
            torch.testing.assert_close(K[i], theirs(one, z).to_dense(), atol=1e-10, rtol=1e-10)
            torch.testing.assert_close(
                variance[i], theirs(one, diag=True).detach(), atol=1e-10, rtol=1e-10
            )

    def test_batch_shapes_broadcast(self, name):
        kernel = KERNELS[name]()
        _, one = sampled(kernel)
        values = {
            n: v * (1.0 + 0.1 * points(*((3, 1) if i % 2 else (2,)), *v.shape).sigmoid())
            for i, (n, v) in enumerate(one.values.items())
        }
        batch = (3, 2) if len(values) > 1 else (2,)
        ours = SampledKernel(one.kernel, values, 2)
        assert ours.batch_shape == batch
        x = points(2, 5, 2)
        K = ours(x, x[:, :3])
        assert K.shape == (*batch, 5, 3)
        k = {n: one.kernel.get_parameter(n).dim() for n in values}
        for i in range(6 if len(values) > 1 else 2):
            index = divmod(i, 2) if len(values) > 1 else (i,)
            at = {n: v.expand(*batch, *v.shape[v.dim() - k[n] :])[index] for n, v in values.items()}
            alone = SampledKernel(one.kernel, at, 2)(x[i % 2], x[i % 2, :3])
            torch.testing.assert_close(K[index], alone)

    def test_gradients(self, name):
        _, ours = sampled(KERNELS[name](), particles=2)
        names = list(ours.values)
        x, z = points(2, 3, 2).requires_grad_(), points(2, 2, seed=1).requires_grad_()

        def evaluate(x, z, *values):
            kernel = SampledKernel(ours.kernel, dict(zip(names, values, strict=True)), 2)
            return kernel(x, z), kernel.diagonal(x)

        values = [v.detach().clone().requires_grad_() for v in ours.values.values()]
        assert torch.autograd.gradcheck(evaluate, (x, z, *values))

    def test_radial(self, name):
        for particles, batch in ((None, ()), (3, (3,))):
            _, ours = sampled(KERNELS[name](), particles)
            if name not in RADIAL:
                assert ours.radial is None
                assert ours.radial_variance is None
                continue
            form, scaled = RADIAL[name]
            assert ours.radial[0] == form
            assert ours.radial[1].shape == (*batch, 2)
            raw = next(v for n, v in ours.values.items() if n.endswith("lengthscale"))
            assert torch.equal(ours.radial[1], raw.squeeze(-2).expand(*batch, 2))
            assert (ours.radial_variance is not None) == scaled
            if scaled:
                assert torch.equal(ours.radial_variance, ours.values["raw_outputscale"])

    def test_the_users_kernel_is_left_alone(self, name):
        kernel = KERNELS[name]()
        before = {k: v.clone() for k, v in kernel.state_dict().items()}
        _, ours = sampled(kernel, particles=2)
        ours(points(3, 2), points(3, 2))
        after = kernel.state_dict()
        assert list(before) == list(after)
        assert all(torch.equal(before[k], after[k]) for k in before)
        assert all(p.requires_grad and p.grad is None for p in kernel.parameters())
        assert {p.dtype for p in kernel.parameters()} == {torch.float32}
        assert all(c._transform is not None for c in kernel.constraints())


@pytest.mark.parametrize("channels", [1, 3])
def test_default_is_matern_32_with_a_lengthscale_for_each_channel(channels):
    trace, ours = sampled(None, particles=2, channels=channels)
    site = trace.nodes["k_lengthscale"]
    assert site["value"].shape == (2, channels)
    assert site["fn"].event_shape == (channels,)
    one = torch.ones(channels, dtype=torch.float64)
    expected = dist.LogNormal(0.0 * one, one).log_prob(site["value"]).sum(-1)
    torch.testing.assert_close(site["fn"].log_prob(site["value"]), expected)
    x = points(5, channels)
    for i in range(2):
        theirs = MaternKernel(1.5, ard_num_dims=channels).double()
        theirs.lengthscale = site["value"][i]
        expected = theirs(x, x[:3]).to_dense()
        torch.testing.assert_close(ours(x, x[:3])[i], expected, atol=1e-7, rtol=0)
    assert torch.equal(ours.diagonal(x), torch.ones(2, 5, dtype=torch.float64))
    assert ours.radial[0] == "matern32"
    assert ours.radial_variance is None


@pytest.mark.parametrize("nu", [0.5, 1.5, 2.5])
def test_smoothness_of_the_default(nu):
    prior = KernelPrior("f", None, 1, nu)
    kernel = prior.sampled({"f_lengthscale": torch.tensor([0.7]).double()})
    x = torch.linspace(-1.0, 1.0, 5).double().unsqueeze(-1)
    exact = MaternKernel(nu).double()
    exact.lengthscale = 0.7
    torch.testing.assert_close(kernel(x, x), exact(x, x).to_dense().detach())
    with pytest.raises(ValueError, match="smoothness: expected none with a kernel"):
        KernelPrior("f", exact, 1, 0.5)


def test_sites_are_named_after_the_parameters():
    kernel = ScaleKernel(RBFKernel()) + ScaleKernel(PeriodicKernel())
    kernel.kernels[1].raw_outputscale.requires_grad_(False)
    kernel.kernels[1].outputscale = 0.25
    kernel.kernels[0].base_kernel.lengthscale = 3.0
    trace, ours = sampled(kernel, particles=2)
    names = [n for n, node in trace.nodes.items() if node["type"] == "sample"]
    assert names == [
        "particles",
        "k_kernels_0_outputscale",
        "k_kernels_0_base_kernel_lengthscale",
        "k_kernels_1_base_kernel_lengthscale",
        "k_kernels_1_base_kernel_period_length",
    ]
    fixed = ours.values["kernels.1.raw_outputscale"]
    assert not fixed.requires_grad
    assert fixed.item() == pytest.approx(0.25, rel=1e-6)
    prior = trace.nodes["k_kernels_0_base_kernel_lengthscale"]["fn"]
    value = torch.tensor([[1.7]], dtype=torch.float64)
    three = torch.tensor(3.0, dtype=torch.float64)
    expected = dist.LogNormal(three.log(), 1.0).log_prob(torch.tensor(1.7, dtype=torch.float64))
    assert prior.log_prob(value)[0].item() == pytest.approx(expected.item(), rel=1e-6)


def test_a_parameter_that_two_kernels_share_is_one_site():
    base = RBFKernel()
    kernel = ScaleKernel(base) + base
    trace, ours = sampled(kernel)
    assert "k_kernels_1_lengthscale" not in trace.nodes
    x = points(4, 2)
    theirs = with_values(kernel, plain(ours.values))
    torch.testing.assert_close(ours(x, x[:2]), theirs(x, x[:2]).to_dense(), atol=1e-10, rtol=0)


@pytest.mark.parametrize("name", ["rbf", "matern32", "matern52", "scaled", "sum", "product"])
def test_second_derivatives(name):
    # GPyTorch's own are silently wrong where the lengthscale is shared by all channels.
    kernel = KERNELS[name]()
    _, ours = sampled(kernel)
    names = list(ours.values)
    values = [v.detach().clone().requires_grad_() for v in ours.values.values()]
    x = points(4, 2)

    def total(*values):
        K = SampledKernel(ours.kernel, dict(zip(names, values, strict=True)), 2)(x, x)
        return (K * points(4, 4, seed=2)).sum()

    assert torch.autograd.gradgradcheck(total, values)


def test_coincident_points_have_finite_derivatives():
    _, ours = sampled(None)
    x = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(ours(x, x).sum(), x, create_graph=True)
    (curvature,) = torch.autograd.grad(slope.square().sum() + slope.sum(), x)
    assert torch.equal(slope, torch.zeros_like(x))
    assert bool(curvature.isfinite().all())


def lengthscale_prior(prior, **kwargs):
    return RBFKernel(lengthscale_prior=prior, **kwargs)


@pytest.mark.parametrize(
    ("prior", "expected"),
    [
        (GammaPrior(3.0, 6.0), dist.Gamma(3.0, 6.0)),
        (LogNormalPrior(0.5, 0.7), dist.LogNormal(0.5, 0.7)),
        (HalfCauchyPrior(2.0), dist.HalfCauchy(2.0)),
        (HalfNormalPrior(2.0), dist.HalfNormal(2.0)),
        (UniformPrior(0.1, 2.0), dist.Uniform(0.1, 2.0)),
    ],
)
def test_a_registered_prior_is_the_sites(prior, expected):
    trace, _ = sampled(lengthscale_prior(prior, ard_num_dims=2), particles=3)
    fn = trace.nodes["k_lengthscale"]["fn"]
    assert fn.event_shape == (1, 2)
    assert trace.nodes["k_lengthscale"]["value"].dtype == torch.float64
    value = torch.tensor([[0.4, 1.3]], dtype=torch.float64)
    torch.testing.assert_close(
        fn.log_prob(value)[0], expected.log_prob(value).sum(), check_dtype=False, rtol=1e-5, atol=0
    )


def test_priors_of_other_parameters():
    free = TentKernel()
    torch.testing.assert_close(
        hyperprior(free.double(), "width").loc.item(), 0.4, rtol=1e-6, atol=0
    )
    free.register_prior("width_prior", NormalPrior(1.0, 2.0), "width")
    assert hyperprior(free, "width").scale.item() == 2.0
    between = RBFKernel(lengthscale_constraint=Interval(0.2, 0.9)).double()
    prior = hyperprior(between, "raw_lengthscale")
    assert float(prior.base_dist.low) == pytest.approx(0.2)
    assert float(prior.base_dist.high) == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("bound", "support"),
    [(GreaterThan(0.3), constraints.greater_than), (LessThan(0.3), constraints.less_than)],
)
def test_one_sided_bounds(bound, support):
    kernel = RBFKernel(lengthscale_constraint=bound).double()
    present = kernel.lengthscale.detach()
    prior = hyperprior(kernel, "raw_lengthscale")
    assert isinstance(prior.support.base_constraint, support)
    value = present + (present - 0.3)  # twice as far from the bound
    distance = (value - 0.3).abs()
    expected = dist.LogNormal((present - 0.3).abs().log(), torch.ones_like(value))
    torch.testing.assert_close(prior.log_prob(value), expected.log_prob(distance).sum())
    draws = prior.sample((200,))
    assert bool(support(torch.tensor(0.3)).check(draws).all())
    # What automatic guides do: the unconstrained space covers the support.
    guide = pyro.infer.autoguide.AutoNormal(lambda: sample_kernel("k", kernel, 1))
    with pyro.get_param_store().scope():
        guide()
        assert bool(support(torch.tensor(0.3)).check(guide.median()["k_lengthscale"]).all())


def transformed_prior():
    kernel = RBFKernel()
    kernel.register_prior(
        "lengthscale_prior", NormalPrior(0.0, 1.0), lambda module: module.lengthscale.log()
    )
    return kernel


def misnamed_prior():
    kernel = RBFKernel()
    kernel.register_prior("my_prior", GammaPrior(3.0, 6.0), "lengthscale")
    return kernel


class TestErrors:
    @pytest.mark.parametrize(
        ("kernel", "message"),
        [
            ("rbf", r"kernel: expected a gpytorch kernel or None, got str"),
            (RBFKernel(batch_shape=torch.Size([2])), r"got batch shape \(2,\)"),
            (lengthscale_prior(NormalPrior(1.0, 1.0)), r"NormalPrior for raw_lengthscale"),
            (lengthscale_prior(UniformPrior(-1.0, 1.0)), r"UniformPrior for raw_lengthscale"),
            (lengthscale_prior(SmoothedBoxPrior(0.1, 1.0)), r"SmoothedBoxPrior .*another prior"),
            (lengthscale_prior(GammaPrior(3.0, 6.0, transform=torch.log)), r"GammaPrior for"),
            (transformed_prior(), r"NormalPrior for raw_lengthscale"),
            (misnamed_prior(), r"named after its parameter.*got my_prior"),
        ],
    )
    def test_kernels(self, kernel, message):
        with pytest.raises(ValueError, match=message):
            sample_kernel("k", kernel, 2)

    @pytest.mark.parametrize(
        "kernel", [RBFKernel(ard_num_dims=3), RBFKernel(ard_num_dims=3) + RBFKernel()]
    )
    def test_lengthscales_of_other_channels(self, kernel):
        with pytest.raises(ValueError, match=r"each of 2 channels.*ard_num_dims"):
            sample_kernel("k", kernel, 2)(points(3, 2), points(3, 2))

    def test_points(self):
        kernel = sample_kernel("k", None, 2)
        with pytest.raises(ValueError, match=r"x2: expected shape.*n, 2\), got shape \(3, 1\)"):
            kernel(points(3, 2), points(3, 1))
        with pytest.raises(ValueError, match=r"x1: expected shape"):
            kernel.diagonal(points(3))

    def test_kernels_of_several_outputs(self):
        kernel = sample_kernel("k", gpytorch.kernels.RBFKernelGrad(), 2)
        with pytest.raises(ValueError, match=r"got shape \(9, 9\).*derivatives are not supported"):
            kernel(points(3, 2), points(3, 2))
