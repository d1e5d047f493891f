"""Conversion of what users pass (lists, arrays, tensors) to float64 tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor


def as_tensor(
    value: Any, dtype: torch.dtype = torch.float64, device: torch.device | None = None
) -> Tensor:
    """Tensor of the given dtype; read-only arrays (those of a Record) are copied."""
    if isinstance(value, Tensor):
        return value.to(dtype=dtype, device=device or value.device)
    if isinstance(value, np.ndarray) and not value.flags.writeable:
        value = value.copy()
    return torch.as_tensor(value, dtype=dtype, device=device)
