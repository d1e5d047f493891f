"""Records and outputs to and from the scale in which priors are stated."""

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp

rng = np.random.default_rng(0)
TWO = dgp.Record(
    np.arange(30) * 0.5, 3.0 + rng.normal(size=(30, 2)), 5.0 + 2.0 * rng.normal(size=(30, 2)),
    input_units=["V", "A"], output_units=["m", "K"], extra={"rain": np.ones(30)},
)  # fmt: skip
SCALING = dgp.Scaling.from_records(TWO)
ONE = TWO.select(outputs=TWO.output_names[0])


def test_scaled_records_have_mean_zero_and_unit_standard_deviation():
    scaled = SCALING.apply(TWO)
    for array in (scaled.inputs, scaled.outputs):
        np.testing.assert_allclose(array.mean(0), 0.0, atol=1e-12)
        np.testing.assert_allclose(array.std(0), 1.0, rtol=1e-12)
    assert (scaled.input_units, scaled.output_units) == (("", ""), ("", ""))
    assert scaled.input_names == TWO.input_names
    np.testing.assert_array_equal(scaled.time, TWO.time)
    assert list(scaled.extra) == ["rain"]


def test_another_record_is_scaled_by_the_training_record():
    later = SCALING.apply(TWO[10:])
    np.testing.assert_array_equal(later.outputs, SCALING.apply(TWO).outputs[10:])
    silent = SCALING.apply(TWO.with_outputs(np.zeros((30, 0)), names=()))
    assert silent.n_outputs == 0
    np.testing.assert_array_equal(silent.inputs, SCALING.apply(TWO).inputs)


def test_records_with_other_channels_or_units_are_refused():
    with pytest.raises(ValueError, match=r"record.output_names: expected"):
        SCALING.apply(ONE)
    other = dgp.Record(TWO.time, TWO.inputs, TWO.outputs, output_units=["mm", "K"],
                       input_units=["V", "A"])  # fmt: skip
    with pytest.raises(ValueError, match="unit of output"):
        SCALING.apply(other)
    with pytest.raises(ValueError, match="record: expected a Record"):
        SCALING.apply(TWO.outputs)


def test_invert_is_the_inverse_for_arrays_and_tensors():
    scaled = SCALING.apply(TWO).outputs
    np.testing.assert_allclose(SCALING.invert(scaled), TWO.outputs, rtol=1e-12)
    draws = torch.stack([torch.tensor(scaled)] * 3)
    found = SCALING.invert(draws)
    assert isinstance(found, torch.Tensor)
    np.testing.assert_allclose(found[2].numpy(), TWO.outputs, rtol=1e-12)
    one = dgp.Scaling.from_records(ONE)
    column = one.apply(ONE).outputs
    for shaped in (column, column[:, 0], torch.tensor(column[:, 0]).expand(4, -1)):
        found = np.asarray(one.invert(shaped))
        expected = ONE.outputs if shaped is column else ONE.outputs[:, 0]
        np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-12)


@pytest.mark.parametrize("outputs", [np.zeros(30), np.zeros((30, 3)), torch.zeros(2, 30, 1)])
def test_another_number_of_outputs_is_refused(outputs):
    with pytest.raises(ValueError, match=r"outputs: expected shape \(\.\.\., n, 2\)"):
        SCALING.invert(outputs)
