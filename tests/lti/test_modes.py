"""Construction, shapes and units of modal systems."""

import re

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given

from pyro_dynogp.lti.covariance import autocovariance, state_covariance
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.response import mean_response
from tests.lti import oracles
from tests.lti.oracles import assert_close, few

GOOD = {
    "poles": [-1.0 + 2.0j, -0.5 - 1.0j],
    "input_gain": [[1.0], [2.0j]],
    "output_gain": [1.0, 1.0j],
    "noise_gain": [[1.0, 0.5], [0.3, 1.0j]],
    "feedthrough": [0.1],
}
TWO_OUTPUTS = GOOD | {"output_gain": [[1.0, 1.0j], [0.5, 2.0]], "feedthrough": [[0.1], [0.2]]}


class TestErrors:
    @pytest.mark.parametrize(
        ("base", "change", "said"),
        [
            (GOOD, {"poles": [-1.0, 0.25 + 1j]}, "poles.*real part.*0.25"),
            (GOOD, {"poles": [-1.0, 0.0 + 1j]}, "poles.*stable"),
            (GOOD, {"poles": -1.0}, "poles.*shape"),
            (GOOD, {"poles": []}, "poles.*P >= 1"),
            (GOOD, {"output_gain": None}, "output_gain"),
            (GOOD, {"output_gain": [1.0, 1.0, 1.0]}, r"output_gain.*2 poles.*\(3,\)"),
            (GOOD, {"output_gain": np.ones((1, 1, 2))}, "output_gain"),
            (GOOD, {"output_gain": 1.0}, "output_gain"),
            (GOOD, {"input_gain": [1.0, 2.0]}, r"input_gain.*\(2,\)"),
            (GOOD, {"input_gain": np.ones((3, 1))}, r"input_gain.*2 poles.*\(3, 1\)"),
            (GOOD, {"noise_gain": [1.0, 2.0]}, "noise_gain"),
            (GOOD, {"noise_gain": np.ones((1, 2))}, "noise_gain"),
            (GOOD, {"feedthrough": [1.0, 2.0]}, "feedthrough"),
            (GOOD, {"feedthrough": torch.ones(1, dtype=torch.complex128)}, "feedthrough.*real"),
            (TWO_OUTPUTS, {"feedthrough": [[0.1, 0.2]]}, "feedthrough"),
            (TWO_OUTPUTS, {"feedthrough": [0.1]}, "feedthrough"),
            (GOOD, {"noise": "white"}, "noise.*'shared' or 'independent'.*'white'"),
            (GOOD, {"poles": [-1.0, complex(np.nan, 1.0)]}, "poles.*finite"),
            (GOOD, {"poles": [-1.0, complex(-1.0, np.inf)]}, "poles.*finite"),
            (GOOD, {"poles": [-1.0, complex(-np.inf, 0.0)]}, "poles.*finite"),
            (GOOD, {"input_gain": [[1.0], [np.nan]]}, "input_gain.*finite"),
            (GOOD, {"output_gain": [np.inf, 1.0]}, "output_gain.*finite"),
            (GOOD, {"noise_gain": [[1.0], [np.nan]]}, "noise_gain.*finite"),
            (GOOD, {"feedthrough": [-np.inf]}, "feedthrough.*finite"),
            (GOOD, {"input_gain": np.ones((3, 2, 1)), "noise_gain": np.ones((4, 2, 1))}, "batch"),
            (GOOD, {"poles": [[-1.0, -2.0]] * 3, "output_gain": np.ones((4, 2))}, "batch"),
        ],
    )
    def test_says_which_argument(self, base, change, said):
        with pytest.raises(ValueError, match=f"(?s){said}"):
            Modes(**base | change)

    @pytest.mark.parametrize("D", [[1.0j], np.array([1.0j])])
    def test_complex_feedthrough_is_refused_in_any_container(self, D):
        with pytest.raises(ValueError, match="feedthrough"):
            Modes(**GOOD | {"feedthrough": D})

    def test_index_without_batch(self):
        with pytest.raises(ValueError, match=r"Modes.*batch"):
            Modes(**GOOD)[0]

    def test_index_must_not_reach_beyond_the_batch(self):
        modes = Modes(**GOOD).expand((3,))
        with pytest.raises((IndexError, ValueError)):
            modes[:, :1]


class TestShapes:
    def test_types_and_defaults(self):
        modes = Modes([-1.0, -2.0], output_gain=np.ones(2, dtype=np.float32))
        assert modes.poles.dtype == modes.C.dtype == torch.complex128
        assert (modes.pairs, modes.inputs, modes.outputs) == (2, 0, 1)
        assert modes.B.shape == modes.L.shape == (2, 0)
        assert modes.D.shape == (1, 0)
        assert modes.batch_shape == ()
        assert not modes.several_outputs
        assert "2 pairs" in repr(modes)

    def test_several_outputs(self):
        modes = Modes(**TWO_OUTPUTS)
        assert modes.several_outputs
        assert modes.outputs == 2
        assert modes.D.shape == (2, 1)

    def test_read_only_arrays_are_copied(self):
        poles = np.array([-1.0 + 2j])
        poles.flags.writeable = False
        modes = Modes(poles, output_gain=[1.0])
        assert modes.poles.tolist() == [-1.0 + 2j]

    def test_batches_broadcast(self):
        modes = Modes(
            poles=np.full((4, 1, 2), -1.0),
            input_gain=np.ones((3, 2, 5)),
            output_gain=np.ones((2,)),
            noise_gain=np.ones((2, 1)),
            feedthrough=np.ones((4, 3, 5)),
        )
        assert modes.batch_shape == (4, 3)
        assert not modes.several_outputs
        assert "batch (4, 3)" in repr(modes)

    @pytest.mark.parametrize("outputs", [None, 2])
    def test_a_batch_is_its_members(self, outputs):
        # Poles of two particles, gains of the first shared by both: indexing broadcasts them.
        members = [oracles.random_system(k, pairs=2, outputs=outputs) for k in range(2)]
        first = members[0]
        batch = Modes(
            np.stack([m.poles for m in members]),
            first.B_modal,
            np.stack([first.modes.output_gain] * 2),
            first.L_modal,
            first.modes.feedthrough,
            noise="independent",
        )
        t, u = oracles.irregular_times(6), oracles.random_inputs(6, 2)
        together = mean_response(batch, t, u).output
        spread = autocovariance(batch, torch.tensor([0.3, -0.2]))
        for k in range(2):
            alone = Modes(
                members[k].poles,
                first.B_modal,
                first.modes.output_gain,
                first.L_modal,
                first.modes.feedthrough,
                noise="independent",
            )
            assert batch[k].noise == "independent"
            assert batch[k].batch_shape == ()
            assert batch[k : k + 1].batch_shape == (1,)
            expected = mean_response(alone, t, u).output
            assert_close(mean_response(batch[k], t, u).output, expected)
            assert_close(together[k], expected)
            assert_close(spread[k], autocovariance(alone, torch.tensor([0.3, -0.2])))

    def test_index_by_mask_and_by_last_batch_dimension(self):
        batch = Modes(**GOOD | {"poles": [[-1.0, -2.0], [-3.0, -4.0], [-5.0, -6.0]]})
        kept = batch[torch.tensor([True, False, True])]
        assert kept.poles.real.tolist() == [[-1.0, -2.0], [-5.0, -6.0]]
        grid = batch.expand((2, 3))
        assert grid[..., 1].batch_shape == (2,)
        assert grid[..., 1].poles.real.tolist() == [[-3.0, -4.0]] * 2

    def test_expand(self):
        wide = Modes(**TWO_OUTPUTS).expand((5, 3))
        assert wide.batch_shape == (5, 3)
        assert wide.several_outputs
        assert (wide.C.shape, wide.D.shape) == ((5, 3, 2, 2), (5, 3, 2, 1))
        assert_close(wide[4, 2].C, Modes(**TWO_OUTPUTS).C)
        with pytest.raises(RuntimeError):
            wide.expand((4,))

    def test_detach(self):
        modes = Modes(**GOOD | {"poles": torch.tensor([-1.0 + 1j, -2.0], requires_grad=True)})
        assert modes.poles.requires_grad
        assert not modes.detach().poles.requires_grad
        assert_close(modes.detach().poles, modes.poles)

    def test_damping_and_natural_frequency(self):
        # s^2 + 2 zeta w s + w^2 with w = 5, zeta = 0.6 has the roots -3 +- 4i.
        modes = Modes([-3.0 + 4.0j], output_gain=[1.0])
        assert modes.natural_frequency.item() == pytest.approx(5.0)
        assert modes.damping.item() == pytest.approx(0.6)

    def test_without_process_noise(self):
        system = oracles.random_system(3)
        quiet = system.modes.without_process_noise()
        t, u = oracles.irregular_times(5), oracles.random_inputs(5, 2)
        assert_close(mean_response(quiet, t, u).output, oracles.mean(system, t, u)[0][:, 0])
        assert state_covariance(quiet).abs().max() == 0.0


def test_one_output_is_several_outputs_without_the_axis():
    one = oracles.random_system(1)
    several = oracles.random_system(1, outputs=1)
    t, u = oracles.irregular_times(7), oracles.random_inputs(7, 2)
    single, column = (mean_response(s.modes, t, u).output for s in (one, several))
    assert single.shape == (7,)
    assert column.shape == (7, 1)
    assert_close(column[:, 0], single)
    lag = torch.tensor([[0.1, -0.4, 2.0]])
    assert autocovariance(one.modes, lag).shape == (1, 3)
    assert_close(autocovariance(several.modes, lag)[..., 0, 0], autocovariance(one.modes, lag))


positive = st.floats(1e-3, 1e3)


class TestRescale:
    @few
    @given(
        time=positive,
        inputs=st.tuples(positive, positive),
        outputs=st.tuples(positive, positive),
        noise=st.sampled_from(oracles.NOISES),
    )
    def test_same_physics_in_other_units(self, time, inputs, outputs, noise):
        system = oracles.random_system(2, outputs=2, noise=noise)
        t, u = oracles.irregular_times(8), oracles.random_inputs(8, 2)
        si, so = np.array(inputs), np.array(outputs)
        other = system.modes.rescale(time=time, inputs=si, outputs=so)
        m = mean_response(other, t * time, u * si).output.numpy()
        assert_close(m / so, oracles.mean(system, t, u)[0])
        lag = np.array([-0.7, 0.0, 0.4])
        S = autocovariance(other, torch.as_tensor(lag * time)).numpy() / np.outer(so, so)
        expected = oracles.covariance(system, lag, [0.0]).reshape(3, 2, 2)
        assert_close(S, expected)

    @pytest.mark.parametrize("outputs", [None, 2])
    def test_scalar_units(self, outputs):
        system = oracles.random_system(4, outputs=outputs)
        t, u = oracles.irregular_times(8), oracles.random_inputs(8, 2)
        other = system.modes.rescale(time=60.0, inputs=1e3, outputs=0.1)
        assert other.several_outputs == (outputs is not None)
        m = mean_response(other, 60.0 * t, 1e3 * u).output
        expected = 0.1 * oracles.mean(system, t, u)[0]
        assert_close(m, expected if outputs else expected[:, 0])

    @few
    @given(time=positive, inputs=positive, outputs=positive)
    def test_round_trip(self, time, inputs, outputs):
        modes = oracles.random_system(5, outputs=2).modes
        there = modes.rescale(time=time, inputs=inputs, outputs=outputs)
        back = there.rescale(time=1 / time, inputs=1 / inputs, outputs=1 / outputs)
        for name in ("poles", "B", "C", "L", "D"):
            assert_close(getattr(back, name), getattr(modes, name), rtol=1e-13)

    def test_batch(self):
        modes = oracles.random_system(6).modes.expand((3,))
        other = modes.rescale(time=2.0, inputs=[1.0, 5.0], outputs=3.0)
        assert other.batch_shape == (3,)
        assert not other.several_outputs
        assert_close(other[1].D, modes.rescale(time=2.0, inputs=[1.0, 5.0], outputs=3.0)[0].D)


def test_repr_is_one_line():
    assert re.fullmatch(r"Modes\(.*\)", repr(oracles.random_system(0, outputs=3).modes))
