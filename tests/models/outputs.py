"""Output processes for tests: of systems without a record, and of linear fits."""

from contextlib import contextmanager
from dataclasses import replace
from unittest import mock

import numpy as np

import pyro_dynogp as dgp
from pyro_dynogp.lti.grid import time_grid
from pyro_dynogp.models.outputs import engine_for, output_process
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.prediction.first_state import beginning


def unit_scaling(inputs, outputs, scale=None, shift=None):
    """A scaling that leaves inputs as they are; y = shift + scale * (scaled y)."""
    return dgp.Scaling(
        time_step=1.0,
        duration=100.0,
        input_offset=np.zeros(inputs),
        input_scale=np.ones(inputs),
        output_offset=np.zeros(outputs) if shift is None else np.asarray(shift),
        output_scale=np.ones(outputs) if scale is None else np.asarray(scale),
        input_names=tuple(f"u{i}" for i in range(inputs)),
        output_names=tuple(f"y{i}" for i in range(outputs)),
        input_units=("",) * inputs,
        output_units=("",) * outputs,
        time_unit="s",
    )


def outputs_along(system, time, inputs, scale=None, shift=None, engine=None):
    """Outputs of a system along times and scaled inputs (n, n_u), by an engine or the usual one."""
    n_y = system.wires[-1].layer.outputs
    scaling = unit_scaling(inputs.shape[-1], n_y, scale, shift)
    # Times may be repeated here; a record's may not.
    record = dgp.Record(np.arange(len(time)), inputs, np.zeros((len(time), n_y)))
    prepared = replace(PreparedRecord.of(record, scaling), grid=time_grid(time))
    return (engine or engine_for(system))(system, prepared)


@contextmanager
def by_moments():
    """Inside, the moment-matching engine serves models that have an exact one, too."""
    with mock.patch("pyro_dynogp.models.outputs.has_exact_density", return_value=False):
        yield


def physical_of(fit):
    """The linear system of a fit in the units of its record, batch of draws."""
    return fit.system.physical(fit.scaling)


def prior_process(fit, record, *, unknown_start=False):
    """Noise-free trajectories of a linear fit along a record, for each draw."""
    (along,) = fit.model.prepare(record)
    system = beginning(fit, along, predicting=unknown_start)
    return output_process(system, along).process.process
