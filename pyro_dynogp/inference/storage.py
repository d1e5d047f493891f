"""Fitted models as one safetensors file whose header holds the rest as JSON. Nothing is pickled."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from pyro_dynogp._errors import invalid
from pyro_dynogp.inference.guides import GaussianGuide
from pyro_dynogp.inference.potential import Potential
from pyro_dynogp.models.linear import LinearDynamicGP
from pyro_dynogp.scaling import Scaling

if TYPE_CHECKING:
    from pyro_dynogp.inference.fit import Fit

FORMAT = "pyro_dynogp.fit"
VERSION = 1
# The models that a file may name: a file never decides what code is run.
MODELS = {"LinearDynamicGP": LinearDynamicGP}


def save(fit: Fit, path: str | Path) -> None:
    """Write a fit to a file; `load` restores every number to the last bit.

    Raises:
        ValueError: where the folder does not exist.
    """
    tensors = {f"draws/{name}": value.contiguous() for name, value in fit.draws.items()}
    tensors |= {f"mode/{name}": value.contiguous() for name, value in fit.mode.items()}
    tensors["history"] = torch.as_tensor(np.ascontiguousarray(fit.history))
    tensors["start_energies"] = torch.as_tensor(np.ascontiguousarray(fit.start_energies))
    if fit.gaussian is not None:
        tensors["gaussian/loc"] = fit.gaussian.loc.contiguous()
        tensors["gaussian/scale_tril"] = fit.gaussian.scale_tril.contiguous()
    options = {
        item.name: getattr(fit.model, item.name)
        for item in fields(fit.model)
        if item.name != "scaling"
    }
    header = {
        "format": FORMAT,
        "version": VERSION,
        "model": type(fit.model).__name__,
        "options": options,
        "scaling": fit.scaling.to_dict(),
        "method": fit.method,
        "seed": fit.seed,
        "training": list(fit.training),
        "diagnostics": dict(fit.diagnostics),
        "sites": list(fit.draws),
    }
    folder = Path(path).resolve().parent
    if not folder.is_dir():
        raise invalid(
            "path", expected="a file in an existing folder", got=str(path), advice="Make it first."
        )
    clones = {name: value.clone() for name, value in tensors.items()}
    save_file(clones, str(path), metadata={FORMAT: json.dumps(header)})


def load(path: str | Path) -> Fit:
    """Read a fit that `Fit.save` wrote.

    Raises:
        ValueError: where the file is missing, damaged, not a pyro_dynogp fit, or of a version
            that this package does not know.
    """
    from pyro_dynogp.inference.fit import Fit

    path = Path(path)
    if not path.is_file():
        raise ValueError(f"load: there is no file {path}.")
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(
            f"load: {path} is not a safetensors file, or it is damaged ({error})."
        ) from error
    if FORMAT not in metadata:
        raise ValueError(
            f"load: {path} is a safetensors file, but not a fit of pyro_dynogp. "
            "Give a file that Fit.save wrote."
        )
    try:
        header = json.loads(metadata[FORMAT])
        version = header["version"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"load: the header of {path} is damaged ({error}).") from error
    if version != VERSION:
        raise ValueError(
            f"load: {path} has format version {version}, this package reads version {VERSION}. "
            "Use the version of pyro_dynogp that wrote it, or fit again."
        )
    try:
        return _restore(Fit, header, tensors)
    except (KeyError, TypeError) as error:
        raise ValueError(f"load: {path} is incomplete or damaged ({error}).") from error


def _restore(kind: type[Fit], header: dict[str, Any], tensors: dict[str, Any]) -> Fit:
    name = header["model"]
    if name not in MODELS:
        raise ValueError(f"load: unknown model {name!r}; known are {sorted(MODELS)}.")
    scaling = Scaling.from_dict(header["scaling"])
    model = MODELS[name](**header["options"], scaling=scaling)
    draws = {site: tensors[f"draws/{site}"] for site in header["sites"]}
    mode = {site: tensors[f"mode/{site}"] for site in header["sites"]}
    gaussian = None
    if "gaussian/loc" in tensors:
        sites = Potential(lambda: model.sample_system(scaling), (), mode).sites
        gaussian = GaussianGuide(
            tensors["gaussian/loc"], tensors["gaussian/scale_tril"], tuple(sites)
        )
    return kind(
        model=model,
        method=header["method"],
        draws=MappingProxyType(draws),
        mode=MappingProxyType(mode),
        history=tensors["history"].numpy(),
        start_energies=tensors["start_energies"].numpy(),
        diagnostics=MappingProxyType(header["diagnostics"]),
        seed=header["seed"],
        training=tuple(header["training"]),
        gaussian=gaussian,
    )
