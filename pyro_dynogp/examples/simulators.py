"""Simulated systems with known truth: exact sampling of stochastic linear systems.

A state-space system with zero-order-hold inputs and white process noise of unit diffusion,

    dx = (A x + B u) dt + L dbeta,    g(t) = C x + D u,    y_k = f(g(t_k)) + e_k,

is sampled without discretisation error: x[k+1] = Ad x[k] + Bd u[k] + w[k], w ~ N(0, Qd).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm, solve_continuous_lyapunov

from pyro_dynogp.data.checks import Array
from pyro_dynogp.data.record import Record
from pyro_dynogp.support.errors import invalid


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What is known of a simulated system (float64 throughout).

    Attributes:
        A: state matrix (n_s, n_s) [1/s].
        B: input matrix (n_s, n_u).
        C: output matrix (1, n_s).
        D: feedthrough (1, n_u).
        L: noise matrix (n_s, n_l), for white noise of unit diffusion.
        nonlinearity: "identity" or "positive part", the f of y = f(g) + e.
        noise_sd: standard deviation of the measurement noise e.
        process_noise_share: stationary variance of C x due to process noise, divided by that
            plus the variance of the noise-free C x + D u over the record.
        linear_train: g at the training times (n_train,), process noise included.
        linear_test: g at the test times (n_test,), where no process noise acts.
        clean_train: f(g), the output without measurement noise, (n_train,).
        clean_test: the same at the test times, (n_test,).
        final_state: state at the last training sample (n_s,), from which the test goes on.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    L: Array
    nonlinearity: str
    noise_sd: float
    process_noise_share: float
    linear_train: Array
    linear_test: Array
    clean_train: Array
    clean_test: Array
    final_state: Array

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Eigenvalues of A (n_s,) [rad/s]."""
        return np.linalg.eigvals(self.A).astype(np.complex128)


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """A simulated experiment: training record, test record, and the truth behind them."""

    train: Record
    test: Record
    full: Record
    truth: Truth


def discretise(A: Array, B: Array, L: Array, step: float) -> tuple[Array, Array, Array]:
    """Exact discrete-time form over one step with the input held.

    The pair (Ad, Bd) is the exponential of the augmented matrix. The noise covariance is Van
    Loan's block exponential (IEEE Trans. Automatic Control 23, 1978) over step / 2^m, then
    doubled m times by Q(2h) = Q(h) + Ad(h) Q(h) Ad(h)'. The block exponential holds exp(-A h)
    and loses all digits where a fast pole makes that large; sums of covariances lose none.

    Args:
        A: state matrix (n_s, n_s) [1/s].
        B: input matrix (n_s, n_u).
        L: noise matrix (n_s, n_l).
        step: time step [s], positive.

    Returns:
        Ad (n_s, n_s), Bd (n_s, n_u) and the noise covariance Qd (n_s, n_s).
    """
    n, n_u = B.shape
    augmented = np.zeros((n + n_u, n + n_u))
    augmented[:n, :n], augmented[:n, n:] = A, B
    pair = expm(augmented * step)
    doublings = max(0, int(np.ceil(np.log2(max(float(np.linalg.norm(A, 1)) * step, 1.0)))))
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -A, L @ L.T, A.T
    block = expm(block * (step / 2**doublings))
    transition = block[n:, n:].T
    Q = transition @ block[:n, n:]
    for _ in range(doublings):
        Q = Q + transition @ Q @ transition.T
        transition = transition @ transition
    return pair[:n, :n], pair[:n, n:], (Q + Q.T) / 2


def simulate_states(
    A: Array, B: Array, L: Array, inputs: Array, step: float, rng: np.random.Generator,
    noisy_samples: int | None = None,
) -> Array:  # fmt: skip
    """State at each sample, from zero, with inputs held over each step.

    Args:
        A: state matrix (n_s, n_s) [1/s].
        B: input matrix (n_s, n_u).
        L: noise matrix (n_s, n_l).
        inputs: u (n, n_u).
        step: time step [s].
        rng: source of the process noise.
        noisy_samples: process noise acts up to this sample (not included); None: on all.

    Returns:
        States (n, n_s); row k is the state at k * step.
    """
    Ad, Bd, Qd = discretise(A, B, L, step)
    n, noisy = len(inputs), len(inputs) if noisy_samples is None else noisy_samples
    # A square root by eigenvalues: Qd has no Cholesky factor where few noises drive many states.
    values, vectors = np.linalg.eigh(Qd)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    drive = inputs[:-1] @ Bd.T
    drive[: max(noisy - 1, 0)] += rng.standard_normal((max(noisy - 1, 0), len(A))) @ root.T
    states = np.zeros((n, len(A)))
    for k in range(n - 1):
        states[k + 1] = Ad @ states[k] + drive[k]
    return states


def simulate_lti(
    seed: int = 0,
    *,
    samples: int = 2500,
    training_samples: int = 1500,
    sampling_time: float = 0.01,
    noise_ratio: float = 0.1,
) -> Simulation:
    """Linear system with a 10-dimensional state: five conjugate pairs in parallel.

    Follows Example 2 of the dynoGP paper, which does not print how its system was drawn; here:
    natural frequencies log-uniform in 1 to 25 rad/s, damping ratios uniform in 0.2 to 0.9,
    B, c and L complex normal. B is scaled so that the noise-free output of each pair has a
    standard deviation uniform in 0.5 to 1.5 over the record, and L (one Brownian motion that
    all pairs share) so that process noise makes a share, log-uniform in 0.1 to 1 %, of the
    variance of the output (in the paper's published Wiener systems the median share is 0.4 %).
    Inputs sin(3 pi t) and sin(5 pi t), state zero at t = 0, no feedthrough. The test part goes on
    from the state at the end of training, without process noise.

    Args:
        seed: of system and noise; the same seed gives the same bits.
        samples: number of samples n.
        training_samples: number of those in the training record.
        sampling_time: step [s].
        noise_ratio: measurement noise's standard deviation over that of the clean output
            (over all n samples).

    Returns:
        Records and truth.

    Raises:
        ValueError: a number out of its range.
    """
    setting = _setting(seed, samples, training_samples, sampling_time, noise_ratio)
    system, inputs = setting.system, setting.inputs
    pairs, n_u = 5, inputs.shape[1]
    frequency = np.exp(system.uniform(np.log(1.0), np.log(25.0), pairs))
    damping = system.uniform(0.2, 0.9, pairs)
    pole = frequency * (-damping + 1j * np.sqrt(1 - damping**2))
    B = system.standard_normal((pairs, n_u)) + 1j * system.standard_normal((pairs, n_u))
    c = np.exp(2j * np.pi * system.uniform(size=pairs))
    L = system.standard_normal(pairs) + 1j * system.standard_normal(pairs)
    spread = system.uniform(0.5, 1.5, pairs)
    share = np.exp(system.uniform(np.log(0.001), np.log(0.01)))
    # Real form of y = 2 Re(c x): the state [Re x, Im x] of each pair.
    A_r = block_diag(*(np.array([[p.real, -p.imag], [p.imag, p.real]]) for p in pole))
    C_r = np.column_stack([2 * c.real, -2 * c.imag]).reshape(1, 2 * pairs)
    L_r = np.column_stack([L.real, L.imag]).reshape(2 * pairs, 1)
    B_r = np.stack([B.real, B.imag], axis=1).reshape(2 * pairs, n_u)
    quiet = simulate_states(A_r, B_r, L_r, inputs, sampling_time, setting.process, noisy_samples=0)
    by_pair = (quiet * C_r).reshape(samples, pairs, 2).sum(axis=2)
    B_r = B_r * np.repeat(spread / by_pair.std(axis=0), 2)[:, None]
    driven = (by_pair * (spread / by_pair.std(axis=0))).sum(axis=1).var()
    L_r = L_r * np.sqrt(share / (1 - share) * driven / _stationary_variance(A_r, C_r, L_r))
    return _experiment(A_r, B_r, C_r, L_r, "identity", setting, name=f"lti {seed}")


def simulate_wiener(
    seed: int = 0,
    *,
    samples: int = 2500,
    training_samples: int = 1500,
    sampling_time: float = 0.01,
    noise_ratio: float = 0.1,
) -> Simulation:
    """Wiener system: linear with a 5-dimensional state, then the positive part max(g, 0).

    The simulated study of the dynoGP paper: A = -Lambda - v v'. The print and the published data
    differ, and the data are followed here. Print: entries of Lambda and v uniform in [0, 1],
    B and L normal with variances 1 and 0.1, "quadratic" beside "positive part". Data: Lambda and
    v uniform in [0, 50], B normal with standard deviation 50, L normal with variance 1/2 (all
    from ten published systems), C standard normal; their noise-free test outputs are the
    positive part of C x, to rounding. In those data sample k is C x after the step that holds
    u[k], that is, the output stamped t_k belongs to t_k + step; here it belongs to t_k.
    Inputs, initial state and test part as in `simulate_lti`.

    Arguments, result and errors are those of `simulate_lti`.
    """
    setting = _setting(seed, samples, training_samples, sampling_time, noise_ratio)
    system, inputs = setting.system, setting.inputs
    v = system.uniform(0, 50, 5)
    A = -np.diag(system.uniform(0, 50, 5)) - np.outer(v, v)
    B = system.normal(0, 50, (5, inputs.shape[1]))
    C = system.standard_normal((1, 5))
    L = system.normal(0, np.sqrt(0.5), (5, 1))
    return _experiment(A, B, C, L, "positive part", setting, name=f"wiener {seed}")


@dataclass(frozen=True)
class _Setting:
    """How a system is excited and measured, and the streams of its random numbers."""

    time: Array
    inputs: Array
    step: float
    training_samples: int
    noise_ratio: float
    system: np.random.Generator
    process: np.random.Generator
    measurement: np.random.Generator


def _setting(
    seed: int, samples: int, training_samples: int, step: float, noise_ratio: float
) -> _Setting:
    """Inputs sin(3 pi t) and sin(5 pi t) at n samples; all numbers are checked."""
    if not 2 <= training_samples < samples:
        raise invalid(
            "training_samples",
            expected=f"between 2 and samples - 1 = {samples - 1}",
            got=f"{training_samples}",
        )
    if not 0 < step < np.inf:
        raise invalid("sampling_time", expected="a positive number [s]", got=f"{step}")
    if not 0 <= noise_ratio < np.inf:
        raise invalid("noise_ratio", expected="zero or a positive number", got=f"{noise_ratio}")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise invalid("seed", expected="an integer, zero or positive", got=repr(seed))
    # Independent streams: another length or noise leaves the draws of the system as they are.
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(int(seed)).spawn(3)]
    time: Array = np.arange(samples, dtype=np.float64) * step
    inputs = np.column_stack([np.sin(3 * np.pi * time), np.sin(5 * np.pi * time)])
    return _Setting(time, inputs, step, training_samples, noise_ratio, *streams)


def _stationary_variance(A: Array, C: Array, L: Array) -> float:
    """Variance of C x due to process noise in the steady state."""
    return float((C @ solve_continuous_lyapunov(A, -L @ L.T) @ C.T).item())


def _experiment(
    A: Array, B: Array, C: Array, L: Array, nonlinearity: str, setting: _Setting, *, name: str
) -> Simulation:
    k, step, inputs = setting.training_samples, setting.step, setting.inputs
    states = simulate_states(A, B, L, inputs, step, setting.process, noisy_samples=k)
    quiet = simulate_states(A, B, L, inputs, step, setting.process, noisy_samples=0) @ C[0]
    linear = states @ C[0]
    clean = np.maximum(linear, 0.0) if nonlinearity == "positive part" else linear
    noise_sd = setting.noise_ratio * float(clean.std())
    outputs = clean + noise_sd * setting.measurement.standard_normal(len(clean))
    record = Record(
        setting.time, inputs, outputs, input_units=["", ""], output_units=[""], name=name
    )
    train, test = record.split(k)
    noise_variance = _stationary_variance(A, C, L)
    truth = Truth(
        A=A, B=B, C=C, D=np.zeros((1, B.shape[1])), L=L, nonlinearity=nonlinearity,
        noise_sd=noise_sd,
        process_noise_share=noise_variance / (noise_variance + float(quiet.var())),
        linear_train=linear[:k], linear_test=linear[k:],
        clean_train=clean[:k], clean_test=clean[k:], final_state=states[k - 1],
    )  # fmt: skip
    for array in vars(truth).values():
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    return Simulation(train=train, test=test, full=record, truth=truth)
