"""Machine code made ahead: every compiled kernel called once, so that no first fit waits for it.

numba compiles a function when it is first called and keeps the result beside the module. All
kernels together take more than a minute of one processor. Wheels cannot carry the result (it is
tied to the processor and to the times of the source files), and an installer runs no code of the
package: so this is a step of its own, which `make` takes and ``pyro-dynogp compile`` offers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.optimise.innovation_energy import Innovations
from pyro_dynogp.models.architectures import LinearDynamicGP, Wiener
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.nonlinear_feedback import NonlinearFeedback
from pyro_dynogp.models.output_process import OutputProcess
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.support.parallel import parallel_map, seeded

# Samples of the record that kernels are called with.
SAMPLES = 12


class _Plant(NamedTuple):
    """A model, a short record of noise, and the outputs that draws of its prior make of it."""

    model: Model
    record: PreparedRecord
    values: dict[str, torch.Tensor]

    @classmethod
    def of(cls, model: Model) -> _Plant:
        noise = np.random.default_rng(0).standard_normal((SAMPLES, 1 + model.outputs))
        time = 0.1 * np.arange(SAMPLES)
        record = Record(time=time, inputs=noise[:, :1], outputs=noise[:, 1:])
        model = model.collapsed
        (prepared,) = model.prepare(record)
        with seeded(0):
            values = {
                site.name: site.prior.sample() for site in model.all_sites(prepared.scaling, 1)
            }
        return cls(model, prepared, values)

    @property
    def outputs(self) -> OutputProcess:
        """Measured outputs of the drawn system."""
        return output_process(self.model.system(self.values, self.record.scaling), self.record)

    def climb(self) -> None:
        """Density and gradient, as every optimiser asks for them."""
        potential = Potential(self.model, ((self.record,),), self.values)
        potential.values_and_gradients(potential.pack(self.values).numpy()[None])

    def compare(self) -> None:
        """Densities of several points, as Gauss-Newton asks for them."""
        potential = Potential(self.model, ((self.record,),), self.values)
        Innovations(potential).local(potential.pack(self.values).numpy())

    def look(self) -> None:
        """What predictions ask for."""
        y, last = self.record.observations, self.record.inputs[-1]
        with torch.no_grad():
            self.outputs.one_step(y)
            self.outputs.ahead(y, 2)
            self.outputs.left_out(y)
            self.outputs.smooth(y)
            self.outputs.smooth(None)
            self.outputs.state_after(y, 0.1, last)


def _exact() -> None:
    for outputs in (1, 2):
        plant = _Plant.of(LinearDynamicGP(1, outputs=outputs, pairs=1))
        plant.climb()
        plant.look()
        # Densities of models whose first state is a site go through tensors.
        _Plant.of(LinearDynamicGP(1, outputs=outputs, pairs=1, initial_state="site")).climb()


def _filter() -> None:
    _Plant.of(Wiener(1, pairs=1)).climb()


def _smoother() -> None:
    _Plant.of(Wiener(1, pairs=1)).look()
    looped = _Plant.of(NonlinearFeedback(1, pairs=1))
    with torch.no_grad():
        looped.outputs.sample()
    looped.compare()


# The longest first. What two of them share is compiled by whichever comes first.
PARTS: dict[str, Callable[[], None]] = {
    "moment filter with its gradient": _filter,
    "moment smoother and free runs": _smoother,
    "exact likelihood and predictions": _exact,
}


def compile_kernels(*, workers: int | None = None, progress: bool = True) -> None:
    """Compile all kernels now, and keep them for later processes.

    Args:
        workers: processes; None for all processors. progress: whether to show a bar.

    Examples:
        >>> from pyro_dynogp.prediction.compilation import compile_kernels
        >>> compile_kernels(workers=1, progress=False)
    """
    parallel_map(
        _call, list(PARTS), workers=workers, progress=progress, description="compiling, once"
    )


def _call(part: str) -> None:
    PARTS[part]()
