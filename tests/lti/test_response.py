"""Mean response against matrix exponentials, scipy.signal and itself in pieces."""

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given
from mpmath import mp
from scipy.linalg import expm
from scipy.signal import cont2discrete, dlsim, lfilter

from pyro_dynogp.lti.covariance import complex_expm1
from pyro_dynogp.lti.fused import propagators
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.response import held_states, hold, mean_response
from tests.lti import oracles
from tests.lti.oracles import assert_close, few, random_system, tensor


def complex_state(z):
    P = z.shape[-1] // 2
    return z[..., :P] + 1j * z[..., P:]


class TestMeanResponse:
    @few
    @given(seed=st.integers(0, 1000), outputs=st.sampled_from([None, 1, 3]))
    def test_irregular_steps_and_initial_state(self, seed, outputs):
        system = random_system(seed, outputs=outputs)
        t, u = oracles.irregular_times(12, seed), oracles.random_inputs(12, 2, seed)
        z0 = np.random.default_rng(seed).standard_normal(6)
        y, states = oracles.mean(system, t, u, z0)
        ours = mean_response(system.modes, t, u, complex_state(z0))
        assert_close(ours.output, y if outputs else y[:, 0])
        assert_close(ours.state, complex_state(states[-1]))

    def test_system_without_inputs(self):
        system = random_system(1, inputs=0)
        t, z0 = oracles.irregular_times(5), np.arange(6.0)
        expected = oracles.mean(system, t, np.zeros((5, 0)), z0)[0][:, 0]
        assert_close(mean_response(system.modes, t, None, complex_state(z0)).output, expected)

    def test_repeated_times(self):
        # An input that acts for no time leaves no trace, except through the feedthrough.
        system = random_system(2)
        t, u = np.array([0.0, 0.5, 0.5, 0.5, 1.2]), oracles.random_inputs(5, 2)
        expected = oracles.mean(system, t, u)[0][:, 0]
        assert_close(mean_response(system.modes, t, u).output, expected)
        changed = u.copy()
        changed[1:3] += 10.0
        m = mean_response(system.modes, t, changed).output
        assert m[4].item() == pytest.approx(expected[4], rel=1e-12)
        assert m[1].item() == pytest.approx(expected[1] + 10.0 * system.D[0].sum(), rel=1e-12)

    @few
    @given(cut=st.integers(1, 18), seed=st.integers(0, 100))
    def test_state_carries_over_a_split_at_any_point(self, cut, seed):
        system = random_system(seed, outputs=2)
        t, u = oracles.irregular_times(20, seed), oracles.random_inputs(20, 2, seed)
        whole = mean_response(system.modes, t, u)
        # The sample at the cut belongs to both pieces: it holds the state that is handed over.
        head = mean_response(system.modes, t[: cut + 1], u[: cut + 1])
        tail = mean_response(system.modes, t[cut:], u[cut:], head.state)
        assert_close(torch.cat([head.output[:-1], tail.output]), whole.output, rtol=1e-13)
        assert_close(tail.state, whole.state, rtol=1e-13)

    @few
    @given(shift=st.sampled_from([-64.0, 0.5, 1024.0]), seed=st.integers(0, 100))
    def test_invariant_to_a_time_shift(self, shift, seed):
        # Multiples of 1/64 s, so that shifting them is exact.
        system = random_system(seed)
        t = np.cumsum(np.random.default_rng(seed).integers(1, 80, 15)) / 64.0
        u = oracles.random_inputs(15, 2, seed)
        one, other = (mean_response(system.modes, x, u).output for x in (t, t + shift))
        assert torch.equal(one, other)

    @few
    @given(a=st.floats(-5, 5), b=st.floats(-5, 5))
    def test_linear_in_the_inputs(self, a, b):
        system = random_system(3)
        t = oracles.irregular_times(10)
        u, w = oracles.random_inputs(10, 2, 0), oracles.random_inputs(10, 2, 1)

        def m(x):
            return mean_response(system.modes, t, x).output

        torch.testing.assert_close(m(a * u + b * w), a * m(u) + b * m(w), rtol=1e-12, atol=1e-12)

    def test_order_of_pairs_does_not_matter(self):
        system = random_system(4)
        t, u = oracles.irregular_times(10), oracles.random_inputs(10, 2)
        order = [2, 0, 1]
        other = Modes(
            system.poles[order],
            system.B_modal[order],
            system.c[0, order],
            feedthrough=system.D[0],
        )
        expected = mean_response(system.modes, t, u).output
        assert_close(mean_response(other, t, u).output, expected, rtol=1e-13)

    def test_batches_of_systems_and_records(self):
        systems = [random_system(k) for k in range(2)]
        t = oracles.irregular_times(6)
        u = np.stack([oracles.random_inputs(6, 2, k) for k in range(3)])
        modes = Modes(
            np.stack([s.poles for s in systems])[:, None],
            np.stack([s.B_modal for s in systems])[:, None],
            np.stack([s.c[0] for s in systems])[:, None],
            feedthrough=np.stack([s.D[0] for s in systems])[:, None],
        )
        y = mean_response(modes, t, u)
        assert y.output.shape == (2, 3, 6)
        assert y.state.shape == (2, 3, 3)
        for i, system in enumerate(systems):
            for k in range(3):
                assert_close(y.output[i, k], oracles.mean(system, t, u[k])[0][:, 0])


class TestLongRecords:
    def test_no_drift(self):
        # One lightly damped pair over 1e5 samples: the same recursion as a digital filter.
        system = random_system(5, pairs=1, inputs=1)
        step, n = 0.01, 100_000
        u = oracles.random_inputs(n, 1)
        discrete = cont2discrete((system.A, system.B, system.C, system.D), step, "zoh")
        t = step * np.arange(n)
        Ad, Bd, Cd, Dd = discrete[:4]
        # Impulse response of two samples and the characteristic polynomial give the filter.
        a = np.poly(Ad)
        h = [Dd[0, 0], (Cd @ Bd)[0, 0], (Cd @ Ad @ Bd)[0, 0]]
        b = [h[0], h[1] + a[1] * h[0], h[2] + a[1] * h[1] + a[2] * h[0]]
        ours = mean_response(system.modes, t, u).output.numpy()
        # np.diff of k * step is not constant to the last bit; the steps differ by 1e-12 s.
        assert_close(ours, lfilter(b, a, u[:, 0]), rtol=1e-9)

    def test_dlsim(self):
        system = random_system(6, outputs=2)
        u = oracles.random_inputs(2000, 2)
        discrete = cont2discrete((system.A, system.B, system.C, system.D), 0.25, "zoh")
        expected = dlsim(discrete, u)[1]
        assert_close(mean_response(system.modes, 0.25 * np.arange(2000), u).output, expected)


class TestSmallSteps:
    @pytest.mark.parametrize("z", [1e-12, 1e-12j, -1e-12 + 1e-12j, -1e-7 + 3.0j, -2.0 - 1e-9j])
    def test_complex_expm1(self, z):
        ours = complex_expm1(torch.tensor(z, dtype=torch.complex128)).item()
        with mp.workdps(50):
            exact = mp.expm1(mp.mpc(z))
            assert float(abs(exact.real - ours.real)) <= 4e-16 * max(abs(ours.real), 1e-300)
            assert float(abs(exact.imag - ours.imag)) <= 4e-16 * max(abs(ours.imag), 1e-300)

    def test_gain_of_a_held_input(self):
        # (exp(z) - 1)/lambda with |z| = 1e-12 is d (1 + z/2) to the last digit.
        lam, d = -3.0 + 4.0j, 2e-13
        modes = Modes([lam], output_gain=[1.0])
        gain = propagators(modes, torch.tensor([d], dtype=torch.float64))[1].item()
        exact = d * (1.0 + 0.5 * lam * d)
        assert abs(gain - exact) < 5e-16 * abs(exact)

    def test_integrating_pole(self):
        # A pole near zero is an integrator: y = 2 Re(c B) u t.
        modes = Modes([-1e-12 + 0j], [[0.5]], [1.0])
        y = mean_response(modes, [0.0, 1.0, 4.0], [[2.0]] * 3).output
        torch.testing.assert_close(
            y, torch.tensor([0.0, 2.0, 8.0], dtype=torch.float64), rtol=1e-11, atol=0.0
        )


class TestGradients:
    def test_every_argument(self):
        system = random_system(7, pairs=2, inputs=2, outputs=2)
        t = np.array([0.0, 0.3, 0.3, 0.5, 1.1])
        names = [system.poles, system.B_modal, system.c, system.D, oracles.random_inputs(5, 2)]
        values = [tensor(x).requires_grad_() for x in names]
        x0 = torch.tensor([0.3 + 1j, -0.2], dtype=torch.complex128, requires_grad=True)

        def f(poles, B, c, D, u, x0):
            r = mean_response(Modes(poles, B, c, None, D), t, u, x0)
            return r.output, r.state

        assert torch.autograd.gradcheck(f, [*values, x0])

    def test_batch_sums_over_shared_arguments(self):
        system = random_system(8, pairs=2, inputs=1)
        poles = tensor(system.poles).requires_grad_()
        u = torch.randn(3, 6, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        t = oracles.irregular_times(6)

        def m(x):
            return mean_response(Modes(poles, system.B_modal, system.c[0]), t, x).output.sum()

        (together,) = torch.autograd.grad(m(u), poles)
        apart = sum(torch.autograd.grad(m(u[k]), poles)[0] for k in range(3))
        assert_close(together, apart)


class TestErrors:
    @pytest.mark.parametrize(
        ("inputs", "said"),
        [
            (None, r"inputs.*\(\.\.\., 4, 2\).*2 inputs.*None"),
            (np.zeros((4, 1)), r"inputs.*\(\.\.\., 4, 2\).*\(4, 1\)"),
            (np.zeros((3, 2)), r"inputs.*\(3, 2\)"),
            (np.zeros(4), r"inputs.*\(4,\)"),
            ([[0, 0], [0, 0], [0, np.nan], [0, 0]], "inputs.*finite.*row 2"),
            ([[0, np.inf], [0, 0], [0, 0], [0, 0]], "inputs.*finite.*row 0"),
        ],
    )
    def test_inputs(self, inputs, said):
        with pytest.raises(ValueError, match=said):
            mean_response(random_system(0).modes, np.arange(4.0), inputs)

    def test_inputs_of_a_batch_name_the_row_in_time(self):
        u = np.zeros((2, 4, 2))
        u[1, 3, 0] = np.nan
        with pytest.raises(ValueError, match="row 3"):
            mean_response(random_system(0).modes, np.arange(4.0), u)

    def test_inputs_to_a_system_without_any(self):
        with pytest.raises(ValueError, match="inputs"):
            mean_response(random_system(0, inputs=0).modes, np.arange(4.0), np.zeros((4, 1)))

    def test_initial_state(self):
        with pytest.raises(ValueError, match=r"initial_state.*\(\.\.\., 3\).*\(2,\)"):
            mean_response(random_system(0).modes, [0.0], [[0.0, 0.0]], torch.zeros(2))

    def test_one_input_may_come_as_a_vector(self):
        modes = random_system(0, inputs=1).modes
        u = oracles.random_inputs(4, 1)
        one, other = (mean_response(modes, np.arange(4.0), x).output for x in (u, u[:, 0]))
        assert torch.equal(one, other)


def test_held_states():
    system = random_system(9)
    t, u = oracles.irregular_times(8), oracles.random_inputs(8, 2)
    assert_close(held_states(system.modes, t, u), complex_state(oracles.mean(system, t, u)[1]))


class TestHold:
    def test_last_value_acts_until_the_next(self):
        u = torch.tensor([[1.0], [2.0], [3.0]])
        at = torch.tensor([0.0, 0.99, 1.0, 2.5, 9.0], dtype=torch.float64)
        assert hold([0.0, 1.0, 2.5], u, at)[:, 0].tolist() == [1, 1, 2, 3, 3]
        assert hold([0.0, 1.0, 2.5], u.expand(4, 3, 1), at).shape == (4, 5, 1)

    def test_repeated_times_hold_the_last_one(self):
        u = torch.tensor([[1.0], [2.0], [3.0]])
        at = torch.tensor([0.5, 1.0], dtype=torch.float64)
        assert hold([0.0, 0.5, 0.5], u, at)[:, 0].tolist() == [3, 3]

    def test_before_the_first_sample(self):
        with pytest.raises(ValueError, match=r"at.*from 1.0 on.*0.5"):
            hold([1.0, 2.0], torch.zeros(2, 1), torch.tensor([1.5, 0.5], dtype=torch.float64))


def test_between_samples_the_response_is_that_of_the_held_input():
    system = random_system(10)
    t, u = np.array([0.0, 0.7, 1.1]), oracles.random_inputs(3, 2)
    fine = np.sort(np.concatenate([t, [0.2, 1.0]]))
    held = hold(t, tensor(u), torch.as_tensor(fine))
    m = mean_response(system.modes, fine, held).output
    # Two exponentials, by hand: from rest over 0.2 s with the first input held.
    J = len(system.A)
    block = np.zeros((J + 2, J + 2))
    block[:J] = np.hstack([system.A, system.B])
    z = (expm(block * 0.2) @ np.concatenate([np.zeros(J), u[0]]))[:J]
    assert m[1].item() == pytest.approx((system.C @ z + system.D @ u[0]).item(), rel=1e-12)
    assert_close(m[[0, 2, 4]], mean_response(system.modes, t, u).output, rtol=1e-12)
