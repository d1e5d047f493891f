"""Fitted models as one safetensors file whose header holds the rest as JSON. Nothing is pickled."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.distributions import biject_to

from pyro_dynogp.data.channels import from_plain, to_plain
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.inference.density import Site
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from pyro_dynogp.inference.posteriors import Mixture, Posterior, Sampled
from pyro_dynogp.inference.stored_layers import layer_of, plain_layer
from pyro_dynogp.layers.noise import Likelihood
from pyro_dynogp.layers.sites import Values
from pyro_dynogp.models.model import Model
from pyro_dynogp.models.wiring import Dynamic, Known, Static
from pyro_dynogp.support.checkpoints import DIGEST, read_tensors, write_tensors
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping
from pyro_dynogp.support.writing import unwritten

FORMAT = "pyro_dynogp.fit"
# Version 7 is written; 4 to 6 are read, too, of which 4 and 5 have no digest.
VERSION, OLDEST, UNMARKED = 7, 4, 5
# The models that a file may name: a file never decides what code is run.
MODELS = ("Model", "Cascade", "LinearDynamicGP")
# Arrays of draws with densities, where there are such.
SOURCE = ("log_p", "log_q", "ancestor")


def save(fit: Fitted, path: str | Path) -> None:
    """Write a fit to a file; `load` restores every number to the last bit.

    Raises:
        ValueError: where the folder does not exist, or a layer has a kernel of the user's.
    """
    options = _options(fit.model)
    tensors = {f"draws/{name}": value for name, value in fit.draws.items()}
    tensors |= {f"mode/{name}": value for name, value in fit.mode.items()}
    tensors["history"] = torch.as_tensor(np.ascontiguousarray(fit.history))
    tensors["start_energies"] = torch.as_tensor(np.ascontiguousarray(fit.start_energies))
    posterior, points = fit.posterior, list[str]()
    if isinstance(posterior, Mixture) and posterior.sites:
        points = list(posterior.points)
        tensors["posterior/weights"] = posterior.weights
        tensors["posterior/loc"] = posterior.loc
        tensors["posterior/scale_tril"] = posterior.scale_tril
        tensors |= {f"point/{name}": value for name, value in posterior.points.items()}
    source = posterior.source if isinstance(posterior, Sampled) else None
    if source is not None:
        tensors |= {f"source/{name}": value for name, value in source.values.items()}
        tensors |= {
            f"source_{name}": torch.as_tensor(np.ascontiguousarray(x))
            for name in SOURCE
            if (x := getattr(source, name)) is not None
        }
    for index, record in enumerate(fit.records):
        tensors |= _arrays(record, f"record/{index}")
    tensors |= {f"log_q/{name}": value for name, value in fit.log_q_sites.items()}
    header = {
        "format": FORMAT,
        "version": VERSION,
        "model": "Model",
        "options": options,
        "scaling": fit.scaling.to_dict(),
        "method": fit.method,
        "seed": fit.seed,
        "records": [_labels(record) for record in fit.records],
        "log_q": list(fit.log_q_sites),
        "diagnostics": dict(fit.diagnostics),
        "sites": list(fit.draws),
        "points": points,
        "source": None if source is None else source.kind,
    }
    path = Path(path)
    try:
        write_tensors(path, tensors, {FORMAT: json.dumps(header)})
    except OSError as error:
        raise unwritten(path, error, "The fit") from error


def load(path: str | Path) -> Fitted:
    """Read a fit that `Fit.save` wrote.

    Files of format 5 and before have no digest of their content: their sites, shapes and numbers
    are checked, but a changed number cannot be seen, and a warning says so.

    Raises:
        ValueError: where the file is missing, damaged, not a pyro_dynogp fit, or of a version
            that this package does not know.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"load: there is no file {path}.")
    again = "Take a copy of it, or fit again."
    tensors, metadata = read_tensors(path, "load", again, marked=False)
    if FORMAT not in metadata:
        raise ValueError(
            f"load: {path} is a safetensors file, but not a fit of pyro_dynogp. "
            "Give a file that Fit.save wrote."
        )
    try:
        header = json.loads(metadata[FORMAT])
        version = header["version"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"load: the header of {path} is damaged ({error}).") from error
    if not isinstance(version, int) or not OLDEST <= version <= VERSION:
        raise ValueError(
            f"load: {path} has format version {version}, this package reads versions {OLDEST} "
            f"to {VERSION}. "
            "Use the version of pyro_dynogp that wrote it, or fit again."
        )
    if DIGEST not in metadata:
        if version > UNMARKED:
            raise ValueError(f"load: {path} is damaged (it has no digest). {again}")
        warnings.warn(
            f"load: {path} was written before files had a digest: changed numbers cannot be seen. "
            "Save the fit again to mend that.",
            stacklevel=5,
        )
    try:
        _refuse_large(header, path.stat().st_size)
        found = _restore(header, tensors)
        _check_numbers(found)
    except Exception as error:  # whatever a file that nobody wrote may lead to
        raise ValueError(f"load: {path} is incomplete or damaged ({error}). {again}") from error
    return found


def _refuse_large(part: object, size: int) -> None:
    """Refuse a header with counts above the number of bytes of its file, before any is used."""
    if isinstance(part, Mapping):
        for name, value in part.items():
            if name not in ("seed", "scaling", "diagnostics", "records"):
                _refuse_large(value, size)
    elif isinstance(part, list):
        for value in part:
            _refuse_large(value, size)
    elif isinstance(part, int) and part > size:
        raise invalid("options", expected=f"counts of at most {size}", got=str(part))


def _check_numbers(fit: Fitted) -> None:
    """Refuse sites that are not the model's, of other shapes, or that are not numbers."""
    sites = {site.name: site.shape for site in fit.model.collapsed.all_sites(
        fit.scaling, len(fit.records))}  # fmt: skip
    count = fit.n_draws
    for kind, values, lead in (("draws", fit.draws, (count,)), ("mode", fit.mode, ())):
        shapes = {name: value.shape for name, value in values.items()}
        expected = {name: (*lead, *shape) for name, shape in sites.items()}
        if shapes != expected:
            raise invalid(kind, expected=f"{expected}", got=f"{shapes}")
        for name, value in values.items():
            if value.dtype != torch.float64 or not bool(value.isfinite().all()):
                raise invalid(f"{kind}/{name}", expected="finite float64 numbers", got="others")


def _options(model: Model) -> dict[str, Any]:
    """Everything that a model is made with but its scaling, as JSON has it."""
    options = {f.name: getattr(model, f.name) for f in fields(model) if f.name != "scaling"}
    options["channels"] = [to_plain(channel) for channel in model.channels]
    for wire in model.wires:
        if isinstance(wire.layer, Known) and plain_layer(wire.layer) is None:
            raise invalid(
                "save",
                expected="layers that are numbers alone",
                got=f"a known function in layer {wire.name!r}",
                advice="A file holds no code: keep fit.draws and the code that makes the model.",
            )
        if isinstance(wire.layer, Static) and wire.layer.kernel is not None:
            raise invalid(
                "save",
                expected="layers with the default kernel (kernel=None)",
                got=f"{type(wire.layer.kernel).__name__} in layer {wire.name!r}",
                advice="A file holds numbers alone, no kernel of gpytorch: keep fit.draws and "
                "the code that makes the model.",
            )
    options["layers"] = [plain_layer(layer) for layer in model.layers]
    options["likelihood"] = asdict(model.likelihood)
    return options


def _model(name: str, options: Mapping[str, Any], scaling: Scaling) -> Model:
    """Inverse of `_options`."""
    given = dict(options)
    given["channels"] = tuple(from_plain(plain) for plain in given["channels"])
    if name == "LinearDynamicGP":  # of version 4: one layer of dynamics
        own = ("outputs", "pairs", "noise", "brownian", "feedthrough", "process_noise")
        given["layers"] = (Dynamic(**{option: given.pop(option) for option in own}),)
        given["integrate"] = "all"
    else:
        given["layers"] = tuple(layer_of(layer) for layer in given["layers"])
        given["likelihood"] = Likelihood(**given["likelihood"])
        if name == "Cascade" and given["initial_state"] == "site":  # what version 4 called "auto"
            given["initial_state"] = "auto"
    return Model(**given, scaling=scaling)


def _restore(header: dict[str, Any], tensors: dict[str, Any]) -> Fitted:
    name = header["model"]
    if name not in MODELS:
        raise ValueError(f"load: unknown model {name!r}; known are {sorted(MODELS)}.")
    scaling = Scaling.from_dict(header["scaling"])
    model = _model(name, header["options"], scaling)
    renamed: dict[str, str] = {}
    if header["version"] == 4 and name == "LinearDynamicGP":
        renamed = {site: f"g_{site}" for site in header["sites"] if site[:13] == "initial_state"}
    draws, mode, points, log_q = (
        FrozenMapping({renamed.get(site, site): tensors[f"{kind}/{site}"] for site in sites})
        for kind, sites in (
            ("draws", header["sites"]), ("mode", header["sites"]),
            ("point", header["points"]), ("log_q", header["log_q"]),
        )
    )  # fmt: skip
    posterior: Posterior
    if "posterior/loc" in tensors:
        loc, root = tensors["posterior/loc"], tensors["posterior/scale_tril"]
        weights = tensors.get("posterior/weights", torch.ones(1, dtype=torch.float64))
        if loc.dim() == 1:  # version 4 has one normal without weights so
            loc, root = loc[None], root[None]
        sites = _sites(model, scaling, mode, points, len(header["records"]))
        posterior = Mixture(weights, points, loc, root, sites)
    elif header["method"] == "map":
        posterior = Mixture.at(mode)
    else:
        source = _source(header, tensors)
        posterior = Sampled(draws, header["method"], log_q_sites=log_q, source=source)
    return Fitted(
        model=model,
        posterior=posterior,
        draws=draws,
        mode=mode,
        history=tensors["history"].numpy(),
        start_energies=tensors["start_energies"].numpy(),
        diagnostics=FrozenMapping(header["diagnostics"]),
        seed=header["seed"],
        records=tuple(
            _record(labels, tensors, f"record/{index}")
            for index, labels in enumerate(header["records"])
        ),
    )


def _source(header: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> PosteriorDraws | None:
    """The draws with densities behind those of a fit, where the file has them."""
    if header.get("source") is None:
        return None
    values = FrozenMapping({site: tensors[f"source/{site}"] for site in header["sites"]})
    log_p, log_q, ancestor = (
        tensors[key].numpy() if (key := f"source_{name}") in tensors else None for name in SOURCE
    )
    group = np.zeros(len(next(iter(values.values()))), dtype=int)
    return PosteriorDraws(values, log_p, log_q, group, header["source"], ancestor)


def _arrays(record: Record, key: str) -> dict[str, Tensor]:
    """The numbers of a record."""
    arrays = {"time": record.time, "inputs": record.inputs, "outputs": record.outputs}
    arrays |= {f"extra/{name}": values for name, values in record.extra.items()}
    return {f"{key}/{name}": torch.tensor(values) for name, values in arrays.items()}


_TEXTS = ("input_names", "output_names", "input_units", "output_units", "time_unit", "name")


def _labels(record: Record) -> dict[str, Any]:
    """Everything else of a record, as JSON has it."""
    labels = {name: getattr(record, name) for name in _TEXTS}
    labels["extra_units"] = dict(record.extra_units)
    if record.start is not None:
        labels["start"] = [record.start.isoformat(), str(record.start.tz)]
    return labels


def _record(labels: Mapping[str, Any], tensors: dict[str, Tensor], key: str) -> Record:
    """Inverse of `_arrays` and `_labels`; what it copies is taken from the tensors."""
    given = dict(labels)
    if "start" in given:
        instant, zone = given["start"]
        given["start"] = pd.Timestamp(instant).tz_convert(zone)
    extra = {name: tensors.pop(f"{key}/extra/{name}").numpy() for name in given["extra_units"]}
    time, inputs, outputs = (
        tensors.pop(f"{key}/{name}").numpy() for name in ("time", "inputs", "outputs")
    )
    return Record(time, inputs, outputs, extra=extra, **given)


def _sites(
    model: Model, scaling: Scaling, mode: Values, points: Values, records: int
) -> tuple[Site, ...]:
    """The sites of the normal posterior in their order, without the training records."""
    found = []
    for site in model.collapsed.all_sites(scaling, records):
        if site.name not in points:
            transform = biject_to(site.prior.support)
            unconstrained = transform.inv(mode[site.name]).shape
            found.append(Site(site.name, site.shape, unconstrained, transform))
    return tuple(found)
