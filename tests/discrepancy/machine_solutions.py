"""Outputs of the linear machines, solved a second time."""

from __future__ import annotations

import numpy as np
from scipy.signal import lsim

from tests.discrepancy.machine_drafts import Draft
from tests.discrepancy.machine_inputs import Array
from tests.discrepancy.machine_rigs import LEAD


def exact(draft: Draft, u: Array) -> Array:
    """Output (n, n_y) of the linear machine without effects, by matrix exponentials."""
    system, t = draft.rig.system, np.arange(len(u)) * draft.rig.step
    D = np.zeros((len(system.C), u.shape[1]))
    linear = (system.A, system.B[:, : u.shape[1]], system.C, D)
    y = lsim(linear, u, t, X0=system.rest, interp=False)[1].reshape(len(t), -1) + system.level
    return np.asarray(draft.rig.curve(y) if draft.rig.curve else y)[LEAD:]
