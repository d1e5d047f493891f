"""Pyro's SVI in pieces that can be kept: same guide, same optimiser, same random numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import pyro
import torch
from pyro.infer import SVI
from pyro.optim import ClippedAdam
from pyro.optim.clipped_adam import ClippedAdam as TorchClippedAdam
from pyro.poutine.runtime import _PYRO_PARAM_STORE
from torch import Tensor
from tqdm import tqdm

from pyro_dynogp.inference.run import Run
from pyro_dynogp.layers.sites import Arguments, Program
from pyro_dynogp.support.checkpoints import Piece
from pyro_dynogp.support.parallel import seeded

# Steps without a rise after which training ends.
PATIENCE = 200
# Steps between two checkpoints, and over which the ELBO is averaged.
CHUNK = 50


class TrainingDivergedError(ValueError):
    """Training left the region where the ELBO can be computed.

    Attributes:
        step: where. parameters: unconstrained values of the guide's parameters at the last good
            checkpoint. elbo: (step,) history up to it.
        sites: names of the sample sites and parameters that were not finite, or whose density
            could not be computed.

    Examples:
        >>> try:
        ...     raise dgp.TrainingDivergedError("the ELBO is not finite", 7, {}, np.zeros(7))
        ... except dgp.TrainingDivergedError as error:
        ...     error.step
        7
    """

    def __init__(
        self,
        message: str,
        step: int,
        parameters: Mapping[str, Tensor],
        elbo: np.ndarray,
        sites: Sequence[str] = (),
    ) -> None:
        super().__init__(message)
        self.step, self.parameters, self.elbo = step, dict(parameters), elbo
        self.sites = tuple(sites)

    def __reduce__(self) -> tuple[Any, ...]:
        """With all attributes, so that it comes whole out of another process."""
        arguments = (str(self), self.step, self.parameters, self.elbo, self.sites)
        return (TrainingDivergedError, arguments)


@dataclass(frozen=True)
class Schedule:
    """How long and how finely SVI trains.

    Attributes:
        steps: most of them. particles: draws of a step. learning_rate: the first one.
    """

    steps: int = 1000
    particles: int = 8
    learning_rate: float = 0.02


@dataclass(frozen=True)
class Trained:
    """Result of `train`.

    Attributes:
        elbo: (steps,) one estimate a step.
        parameters: unconstrained values of the guide's parameters, by name.
        message: why training ended.
    """

    elbo: np.ndarray
    parameters: dict[str, Tensor]
    message: str


def train(
    model: Program,
    guide: Program,
    args: Arguments,
    loss: Any,
    run: Run,
    schedule: Schedule,
    *,
    key: str = "svi",
    rise: float = 0.05,
    layers: Mapping[str, str] = MappingProxyType({}),
) -> Trained:
    """Maximise an ELBO in the current parameter store, which should be a scope of its own.

    Stops early when the ELBO, averaged over 50 steps, has not risen by `rise` nats in 200
    steps. The learning rate falls to a tenth over all steps.

    Args:
        layers: what to call the layer of a site in an error, by the first part of the site's name.

    Raises:
        TrainingDivergedError: where the ELBO is not a number or cannot be computed; it names the
            parameters concerned and holds the last good state.
    """
    steps = schedule.steps
    settings = {"lr": schedule.learning_rate, "lrd": 0.1 ** (1.0 / steps), "clip_norm": 10.0}
    optimizer = ClippedAdam(settings)
    svi = SVI(model, guide, optimizer, loss)
    elbo: list[float] = []
    state: Piece | None = None
    live = True  # whether store and optimiser are where `state` says
    best, best_step = -np.inf, 0
    message = "all steps used"
    with tqdm(total=steps, desc=key, disable=not run.progress) as bar, seeded(run.seed):
        while len(elbo) < steps:
            first, count = len(elbo), min(CHUNK, steps - len(elbo))
            before, ready = state, live
            live = False

            def advance(before: Any = before, ready: bool = ready, count: int = count) -> Any:
                nonlocal live
                if before is not None and not ready:
                    _restore(optimizer, settings, before, lambda: guide(*args))
                values = [
                    _step(svi, args, len(elbo) + i, before, elbo, layers) for i in range(count)
                ]
                live = True
                return {**_state(optimizer), "elbo": torch.tensor(values, dtype=torch.float64)}

            state = run.checkpoints.piece(f"{key}-{first + count:07d}", advance)
            elbo.extend(state["elbo"].tolist())
            bar.update(count)
            smoothed = float(np.mean(elbo[-CHUNK:]))
            bar.set_postfix(elbo=f"{smoothed:.2f}", refresh=False)
            if smoothed > best + rise:
                best, best_step = smoothed, len(elbo)
            elif len(elbo) - best_step >= PATIENCE:
                message = "the ELBO no longer rises"
                break
        if state is not None and not live:
            _restore(optimizer, settings, state, lambda: guide(*args))
    parameters = {name: p.detach().clone() for name, p in _unconstrained().items()}
    return Trained(np.asarray(elbo), parameters, message)


def _step(
    svi: SVI,
    args: Arguments,
    step: int,
    state: Piece | None,
    elbo: list[float],
    layers: Mapping[str, str],
) -> float:
    before = {name: p.detach().clone() for name, p in _unconstrained().items()}
    try:
        value = -svi.step(*args)
    except (ValueError, torch.linalg.LinAlgError) as error:  # NotPositiveDefiniteError is one
        raise _diverged(
            str(error).rstrip("."), step, state, elbo, before, svi, args, layers
        ) from error
    bad = any(not bool(torch.isfinite(p).all()) for p in _unconstrained().values())
    if not np.isfinite(value) or bad:
        reason = f"the ELBO became {value}" if not np.isfinite(value) else "a parameter overflowed"
        raise _diverged(reason, step, state, elbo, before, svi, args, layers)
    return float(value)


def _diverged(
    reason: str,
    step: int,
    state: Piece | None,
    elbo: list[float],
    before: Mapping[str, Tensor],
    svi: SVI,
    args: Arguments,
    layers: Mapping[str, str],
) -> TrainingDivergedError:
    good = before if all(bool(torch.isfinite(p).all()) for p in before.values()) else {}
    if not good and state is not None:
        good = {n[len("param/") :]: v for n, v in state.items() if n.startswith("param/")}
    bad = [name for name, p in _unconstrained().items() if not bool(torch.isfinite(p).all())]
    bad += [name for name in _broken_sites(svi, args) if name not in bad]
    where = ""
    if bad:
        named = dict.fromkeys(
            text for name in bad for key, text in layers.items() if _of(name, key)
        )
        where = f" Not finite: {', '.join(bad)}" + (f" ({', '.join(named)})" if named else "") + "."
    return TrainingDivergedError(
        f"SVI diverged at step {step}: {reason}.{where} Try a lower learning_rate, more particles, "
        "another seed, or fewer pairs. The last good parameters are in the error's `parameters`.",
        step,
        good,
        np.asarray(elbo),
        bad,
    )


def _of(site: str, layer: str) -> bool:
    """Whether a site or a guide's parameter belongs to a layer."""
    return any(part == layer or part.startswith(f"{layer}_") for part in site.split("."))


def _broken_sites(svi: SVI, args: Arguments) -> list[str]:
    """Sites whose value or density is not finite, or cannot be computed, in one run."""
    guide = pyro.poutine.trace(svi.guide)
    with torch.no_grad(), pyro.validation_enabled(False):
        try:
            guide(*args)
            model = pyro.poutine.trace(pyro.poutine.replay(svi.model, guide.trace))
            model(*args)
            nodes = model.trace.nodes
        except (ValueError, RuntimeError):  # what it had come to tells enough
            nodes = guide.trace.nodes
    return [name for name, node in nodes.items() if _is_broken(node)]


def _is_broken(node: Mapping[str, Any]) -> bool:
    if node["type"] != "sample":
        return False
    try:
        density = torch.as_tensor(node["fn"].log_prob(node["value"]))
    except (ValueError, RuntimeError):
        return True
    value = torch.as_tensor(node["value"])
    latent = not node["is_observed"]  # a missing output is NaN and no error
    return bool(~torch.isfinite(density).all()) or bool(latent and ~torch.isfinite(value).all())


def _unconstrained() -> dict[str, Tensor]:
    return {name: p for name, p in _PYRO_PARAM_STORE.named_parameters()}  # noqa: C416


def _state(optimizer: Any) -> Piece:
    """Parameters, optimiser and generator as tensors."""
    out: Piece = {"random": torch.get_rng_state()}
    for name, value in _unconstrained().items():
        out[f"param/{name}"] = value.detach().clone()
    for name, state in optimizer.get_state().items():
        for entry, value in state["state"].get(0, {}).items():
            out[f"adam/{name}/{entry}"] = torch.as_tensor(value, dtype=torch.float64).clone()
        rate = state["param_groups"][0]["lr"]
        out[f"rate/{name}"] = torch.tensor(rate, dtype=torch.float64)
    return out


def _restore(
    optimizer: Any, settings: Mapping[str, float], piece: Piece, initialise: Callable[[], Any]
) -> None:
    """Put a kept state into store, optimiser and generator; `initialise` makes the parameters."""
    with torch.no_grad(), pyro.poutine.block():
        initialise()
    store = _unconstrained()
    waiting = {}
    for entry, value in piece.items():
        if not entry.startswith("param/"):
            continue
        name = entry[len("param/") :]
        store[name].data.copy_(value)
        if f"rate/{name}" not in piece:
            continue
        whole = TorchClippedAdam([torch.zeros(1)], **settings).state_dict()
        whole["param_groups"][0]["lr"] = float(piece[f"rate/{name}"])
        prefix = f"adam/{name}/"
        kept = {k[len(prefix) :]: v for k, v in piece.items() if k.startswith(prefix)}
        whole["state"] = {0: {k: int(v) if k == "step" else v.clone() for k, v in kept.items()}}
        waiting[name] = whole
    # Optimisers take a waiting state when their parameter is first stepped.
    optimizer.optim_objs.clear()
    optimizer.set_state(waiting)
    torch.set_rng_state(piece["random"])
