"""A small twin of a fit, beside NUTS on the same data: how far the posterior is off, and where."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from pyro.ops.stats import split_gelman_rubin
from torch import Tensor

from pyro_dynogp.criticism.finding import Finding, apart
from pyro_dynogp.criticism.posterior_draws import equal_draws, log_joint
from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.nuts import Chains, sample_posterior
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.prediction.predict import predict
from pyro_dynogp.support.errors import invalid

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

FEWEST = 20
# What is good enough. A mean that is off by 0.2 sd, or an sd by a factor 1.2, costs 0.02 nats of a
# prediction; of parameters less is known, so that less is asked.
SITE_MEAN, SITE_FACTOR = 0.5, 1.5
PREDICTION_MEAN, PREDICTION_FACTOR = 0.2, 1.2
# R-hat above which NUTS itself has not settled, on a site or on the log joint density.
UNSETTLED = 1.1
# Draws of NUTS that predict.
MOST = 400


@dataclass(frozen=True)
class Effort:
    """What NUTS spends on the twin: number of chains, of draws and warm-up steps of each."""

    chains: int = 4
    draws: int = 150
    warmup: int = 150


@dataclass(frozen=True, eq=False)
class Gap:
    """How far two posteriors of the same quantities are apart.

    Attributes:
        names: (d,) of the quantities. mean: (d,) difference of means over NUTS's sd.
        ratio: (d,) sd over NUTS's.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    ratio: np.ndarray


def twin_findings(
    fit: Fitted,
    samples: int,
    *,
    seed: int = 0,
    workers: int | None = None,
    progress: bool = False,
    effort: Effort | None = None,
) -> list[Finding]:
    """What a twin of the fit on its first samples says; see `check`.

    Args:
        fit: the fit. samples: n of the twin. seed: for draws and chains.
        workers: processes for the chains. progress: whether NUTS shows a bar.
        effort: of NUTS.

    Raises:
        ValueError: on trajectories as sites, a fit by NUTS, a number of samples out of range, or
            first samples of which none is measured.
    """
    effort = effort or Effort()
    small = refit(fit, _first(fit, samples))
    target = small.model.collapsed
    records = small.model.prepare(small.records)
    values = {name: value.detach() for name, value in small.mode.items()}
    chains = sample_posterior(
        target,
        records,
        values,
        Run(seed, workers, progress),
        chains=effort.chains,
        draws=effort.draws,
        warmup=effort.warmup,
    )
    drawn = {name: x.flatten(0, 1) for name, x in chains.draws.items()}
    settled = _settled(small, drawn, effort)
    own = equal_draws(small, seed=seed)
    potential = Potential(target, (records,), values)
    sites, left = _sites(potential, own.values, chains)
    predictions = _predictions(small, drawn)
    known = bool(settled <= UNSETTLED)
    whose = f"{own.kind} (predictions: the mode)" if fit.method == "map" else own.kind
    about = (
        f"{whose} against {effort.chains} x {effort.draws} draws of NUTS, on the first samples; "
        f"R-hat of NUTS's log density {settled:.2f}"
    )
    if not known:
        about += f" (above {UNSETTLED}: it has not settled, nothing is judged by it)"
    unsure = f"; {left} not judged, on which NUTS's chains differ (pairs that swap)" if left else ""
    return [
        Finding("twin", float(samples), None, about),
        *_judged("sites", sites, np.max, SITE_MEAN, SITE_FACTOR, known, unsure),
        *_judged("predictions", predictions, _rms, PREDICTION_MEAN, PREDICTION_FACTOR, known, ""),
    ]


def _first(fit: Fitted, samples: int) -> list[Record]:
    """The first samples of the training record; of several records, the same share of each."""
    fit.check_collapsed()
    if fit.method == "nuts":
        raise invalid(
            "twin", expected="False for a fit by NUTS, which is what others are held against",
            got=repr(samples),
        )  # fmt: skip
    whole = sum(len(record) for record in fit.records)
    number = isinstance(samples, int) and not isinstance(samples, bool)
    if not number or not FEWEST <= samples <= whole:
        raise invalid(
            "twin", expected=f"False, or a number of samples from {FEWEST} to {whole}",
            got=repr(samples), advice="100 to 200 are a compromise of sharpness and time.",
        )  # fmt: skip
    parts = [record[: max(2, round(len(record) * samples / whole))] for record in fit.records]
    if all(part.missing.all() for part in parts):
        raise invalid("twin", expected="a number that reaches measured samples", got=repr(samples))
    return parts


def _settled(fit: Fitted, drawn: Mapping[str, Tensor], effort: Effort) -> float:
    """R-hat of the log joint density, which pairs that swap do not change."""
    level = torch.as_tensor(log_joint(fit, drawn)).reshape(effort.chains, effort.draws)
    return float(split_gelman_rubin(level))


def _sites(potential: Potential, own: Mapping[str, Tensor], chains: Chains) -> tuple[Gap, int]:
    """Every number of every site, unconstrained, and how many NUTS's chains do not agree on.

    Scales and decay rates are compared by their logarithms: their own tails have no sd.
    """
    names: list[str] = []
    means, ratios = [], []
    left = 0
    for site in potential.sites:
        theirs = site.transform.inv(chains.draws[site.name])
        theirs = theirs.reshape(*theirs.shape[:2], -1)
        ours = site.transform.inv(own[site.name])
        ours = ours.reshape(len(ours), -1)
        for i in range(ours.shape[-1]):
            if not float(split_gelman_rubin(theirs[..., i])) <= UNSETTLED:
                left += 1
                continue
            sd = theirs[..., i].std()
            names.append(f"{site.name}[{i}]" if ours.shape[-1] > 1 else site.name)
            means.append(float((ours[:, i].mean() - theirs[..., i].mean()) / sd))
            ratios.append(float(ours[:, i].std() / sd))
    return Gap(tuple(names), np.array(means), np.array(ratios)), left


def _predictions(fit: Fitted, drawn: Mapping[str, Tensor]) -> Gap:
    """Every measured output, one step ahead."""
    count = len(next(iter(drawn.values())))
    thin = np.linspace(0, count - 1, min(count, MOST)).round().astype(int)
    sampled = fit.with_draws({name: x[thin] for name, x in drawn.items()})
    names: list[str] = []
    means, ratios = [], []
    for record in fit.records:
        ours, theirs = predict(fit, record), predict(sampled, record)
        there = ~record.missing
        names += [f"sample {k}" for k in np.argwhere(there)[:, 0]]
        means.append(((ours.mean - theirs.mean) / theirs.sd)[there])
        ratios.append((ours.sd / theirs.sd)[there])
    return Gap(tuple(names), np.concatenate(means), np.concatenate(ratios))


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _judged(
    what: str,
    gap: Gap,
    size: Callable[[np.ndarray], float],
    mean: float,
    factor: float,
    known: bool,
    unsure: str,
) -> list[Finding]:
    """Means and sds against their limits, by the largest gap or by its root mean square."""
    if not gap.names:
        return [Finding(f"twin {what}", np.nan, None, f"nothing to compare{unsure}")]
    how = "largest of" if size is np.max else "root mean square over"
    count = f"{how} {len(gap.names)}"
    off = float(size(np.abs(gap.mean)))
    bad = off > mean
    worst = gap.names[int(np.argmax(np.abs(gap.mean)))]
    found, limit = apart(off, mean)
    text = f"means off by {found} of NUTS's sds, {count} (good: up to {limit}); worst: {worst}"
    first = Finding(f"twin {what}, means", off, not bad if known else None, text + unsure, mean)
    with np.errstate(divide="ignore"):
        log_ratio = np.log(gap.ratio)
    spread = float(np.exp(size(np.abs(log_ratio))))
    bad = spread > factor
    i = int(np.argmax(np.abs(log_ratio)))
    found, limit = apart(spread, factor)
    shape = "too narrow" if gap.ratio[i] < 1.0 else "too wide"
    text = (
        f"sds off by a factor {found}, {count} (good: up to {limit}); worst: {gap.names[i]}, "
        f"{gap.ratio[i]:.2f} of NUTS's"
    )
    if bad:
        text += f", {shape}"
    if gap.ratio.min() == 0.0:
        fixed = int((gap.ratio == 0.0).sum())
        text += f"; {fixed} kept at the optimum, without any spread"
    good = not bad if known else None
    return [first, Finding(f"twin {what}, sds", spread, good, text + unsure, factor)]
