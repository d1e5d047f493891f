"""The one place where it is chosen how outputs are computed: exactly, or by moment matching."""

from __future__ import annotations

from pyro_dynogp.models.draws import JointState
from pyro_dynogp.models.exact_outputs import ExactOutputs, has_exact_density
from pyro_dynogp.models.late_outputs import LateOutputs
from pyro_dynogp.models.moment_outputs import MomentOutputs
from pyro_dynogp.models.output_process import OutputProcess
from pyro_dynogp.models.prepared import PreparedRecord
from pyro_dynogp.models.system import System


def engine_for(system: System, start: JointState | None = None) -> type[OutputProcess]:
    """Exact where only the last layer's trajectory is unknown and noise is Gaussian."""
    exact = has_exact_density(system) and (start is None or system.is_linear)
    return ExactOutputs if exact else MomentOutputs


def output_process(
    system: System,
    record: PreparedRecord,
    *,
    start: JointState | None = None,
) -> OutputProcess:
    """Measured outputs of a system along a record.

    Args:
        system: at the beginning of the record. record: times and inputs.
        start: state at the first time, where it is not what the system says.
    """
    engine = engine_for(system, start)
    if start is None and record.arrived:
        return LateOutputs(system, record, engine)
    return engine(system, record, start)
