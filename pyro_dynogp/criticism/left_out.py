r"""Predictive densities of data that were left out, sample by sample: the three targets.

Leaving sample i out turns the posterior into one proportional to
p(theta | y) / p(y_i | y_-i, theta), so that draws theta_s of q get the ratios
p(y, theta_s) / (q(theta_s) p(y_i | y_-i, theta_s)) (Magnusson, Andersen, Jonasson & Vehtari 2019;
Buerkner, Gabry & Vehtari 2021 for outputs that are not independent). Forecasts leave out all of the
future in the same way (Buerkner, Gabry & Vehtari 2020). Where Pareto's k says that ratios do not
suffice, the model is fitted again.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from scipy.special import logsumexp
from tqdm import trange

from pyro_dynogp.criticism.subjects import FitSubject, Subject
from pyro_dynogp.inference.pareto import good_k, psis
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.parallel import parallel_map


@dataclass(frozen=True, eq=False)
class Base:
    """Importance weights of the draws for the posterior of all data.

    Attributes:
        log_ratio: (S,) of posterior over proposal, zeros where uncorrected.
        log_weights: (S,) normalised and smoothed.
        k: Pareto shape of the proposal; 0 for draws of the posterior itself.
        corrected: whether the ratios are used.
        ancestor: (S,) as of the draws.
    """

    log_ratio: np.ndarray
    log_weights: np.ndarray
    k: float
    corrected: bool
    ancestor: np.ndarray | None = None

    @classmethod
    def of(cls, subject: Subject) -> Base:
        """Ratios, or none where the posterior's own k says that they are not to be trusted."""
        draws = subject.draws
        ratio, ancestor = draws.log_ratio, draws.ancestor
        log_weights, k = psis(ratio)
        if k <= good_k(len(ratio)):
            return cls(ratio, log_weights, float(k), True, ancestor)
        plain = np.full(len(ratio), -np.log(len(ratio)))
        return cls(np.zeros_like(ratio), plain, float(k), False, ancestor)


@dataclass
class Found:
    """What a target came to, sample by sample.

    Attributes:
        base: weights of the draws. index: (N,) place of each scored sample among all measured ones.
        elpd, k: (N,). lppd: with the posterior of all data. error: Monte Carlo standard error.
        refits: how many. left: samples whose k is too high, not refitted.
    """

    base: Base
    index: np.ndarray
    elpd: np.ndarray
    k: np.ndarray
    lppd: float
    error: float
    refits: int = 0
    left: int = 0
    notes: list[str] = field(default_factory=list)


def mixture(log_weights: np.ndarray, log_density: np.ndarray) -> np.ndarray:
    """Log of the weighted mean density: weights (N, S), densities (S, N) to (N,)."""
    return logsumexp(log_weights + log_density.T, axis=-1)


def monte_carlo_error(
    log_weights: np.ndarray,
    log_density: np.ndarray,
    elpd: np.ndarray,
    ancestor: np.ndarray | None = None,
) -> float:
    """Standard error of the sum of `mixture` from its draws, by the delta method.

    Each draw's influence is summed over samples first: all of them share the draws.

    Args:
        log_weights: (N, S). log_density: (S, N). elpd: (N,).
        ancestor: (S,) as of `PosteriorDraws`.
    """
    share = np.exp(log_weights + log_density.T - elpd[:, None]) - np.exp(log_weights)
    return spread_of(share.sum(0), ancestor)


def spread_of(influence: np.ndarray, ancestor: np.ndarray | None) -> float:
    """Standard error of a sum over draws from their influences (S,).

    Draws of one ancestor are not independent: their influences are added up first.

    Source: Lee & Whiteley, Biometrika 105(3):609 (2018), without its factor for few particles.
    """
    if ancestor is not None:
        influence = np.bincount(ancestor, influence)
    return float(np.sqrt(np.square(influence).sum()))


def missing_sample(subject: Subject, most: int, workers: int | None, progress: bool) -> Found:
    """Each sample given all others, by importance sampling; by refits where that does not do."""
    density = subject.pointwise("missing sample")
    base = Base.of(subject)
    log_weights, k = psis(base.log_ratio - density.T)
    elpd = mixture(log_weights, density)
    whole = base.log_weights
    lppd = float(mixture(np.broadcast_to(whole, log_weights.shape), density).sum())
    error = monte_carlo_error(log_weights, density, elpd, base.ancestor)
    N = density.shape[1]
    found = Found(base, np.arange(N), elpd, k, lppd, error)
    _note(found, subject)
    high = np.flatnonzero(k > good_k(len(whole)))
    worst = high[np.argsort(-k[high])][:most]
    found.left = len(high) - len(worst)
    if len(worst):
        again = parallel_map(
            lambda i: _one_left_out(subject, int(i), N),
            list(worst),
            workers=workers,
            progress=progress,
            description="refits",
        )
        found.elpd[worst] = again
        found.refits = len(worst)
    return found


def _one_left_out(subject: Subject, i: int, N: int) -> float:
    without = subject.moved if isinstance(subject, FitSubject) else subject.without
    other = without(np.arange(N) == i)
    density = other.pointwise("missing sample")[:, i]
    return float(logsumexp(Base.of(other).log_weights + density))


def forecast(
    subject: Subject, horizon: int, begin: int | float, most: int, progress: bool
) -> Found:
    """Forwards through the record: ratios take in what came since the last fit, until a refit.

    Draws given less data are wider than what they stand for, and have not seen what is forecast.
    Where draws are of all parameters there is one fit, to the past of the first forecast; later its
    draws are moved on to more data. Where no refit is allowed, ratios take the
    future out of the draws given all data instead.
    """
    places = subject.places
    if len(np.unique(places["record"])) > 1:
        raise invalid(
            "record",
            expected="one record for 'forecast'",
            got=f"{len(np.unique(places['record']))}",
            advice="Forecast each record by itself, or use target='new record'.",
        )
    sample = places["sample"]
    first = _first_sample(begin, int(sample.max()) + 1)
    scored = np.flatnonzero(sample >= first + horizon - 1)
    if not len(scored) or first < 2:
        raise invalid(
            "begin", expected="samples before and after it", got=repr(begin),
            advice="Give the number of samples that the first forecast may use.",
        )  # fmt: skip
    step, target = _both(subject, horizon)
    base = Base.of(subject)
    found = Found(base, scored, np.zeros(len(scored)), np.zeros(len(scored)), 0.0, 0.0)
    _note(found, subject)
    whole = base.log_weights
    found.lppd = float(mixture(np.broadcast_to(whole, (len(scored), len(whole))),
                               target[:, scored]).sum())  # fmt: skip
    if len(whole) == 1:  # one draw weighs what it weighs, whatever is left out
        found.elpd = target[0, scored]
        return found
    good = good_k(len(whole))
    shares: list[np.ndarray] = []  # influences on forecasts of the draws since the last fit
    errors: list[float] = []
    current = base
    past: Subject | None = None
    end = len(sample)  # data before this one are in the current fit
    for place in trange(len(scored), desc="forecasts", disable=not progress):
        i = int(scored[place])
        # Outputs of one time follow one another at horizon 1; further ahead whole times do.
        known = i if horizon == 1 else int(np.searchsorted(sample, sample[i] - horizon + 1))
        log_weights, k = _given(current, step, known, end)
        if found.refits < most and (k > good or end > known):
            left_out = np.arange(len(sample)) >= known
            if isinstance(past, FitSubject) and past.carries:
                past = past.carried(left_out)
            else:
                if shares:  # other draws from here on
                    errors.append(spread_of(np.sum(shares, axis=0), None))
                    shares = []
                past = subject.without(left_out)
            step, target = _both(past, horizon)
            current, end = Base.of(past), known
            found.refits += 1
            log_weights, k = _given(current, step, known, end)
        if k > good:
            found.left += 1
        found.k[place] = k
        found.elpd[place] = logsumexp(log_weights + target[:, i])
        share = np.exp(log_weights + target[:, i] - found.elpd[place]) - np.exp(log_weights)
        if current.ancestor is not None:
            share = np.bincount(current.ancestor, share, len(share))
        shares.append(share)
    errors.append(spread_of(np.sum(shares, axis=0), None))
    found.error = float(np.sqrt(np.square(errors).sum()))
    return found


def _both(subject: Subject, horizon: int) -> tuple[np.ndarray, np.ndarray]:
    """One-step densities, which say what ratios are, and those of the target (S, N)."""
    step = subject.pointwise("forecast", 1)
    return step, step if horizon == 1 else subject.pointwise("forecast", horizon)


def _given(base: Base, step: np.ndarray, known: int, end: int) -> tuple[np.ndarray, float]:
    """Weights (S,) for the posterior given the first `known` samples, and Pareto's k.

    Draws are of a fit to the first `end` samples.
    """
    if known >= end:
        ratio = base.log_ratio + step[:, end:known].sum(1)
    else:
        ratio = base.log_ratio - step[:, known:end].sum(1)
    log_weights, k = psis(ratio)
    return log_weights, float(k)


def _first_sample(begin: int | float, n: int) -> int:
    if isinstance(begin, float) and 0.0 < begin < 1.0:
        return int(begin * n)
    if isinstance(begin, int) and 2 <= begin < n:
        return begin
    raise invalid(
        "begin", expected=f"a share between 0 and 1, or a number from 2 to {n - 1}", got=repr(begin)
    )


def new_record(subject: Subject, folds: int, workers: int | None, progress: bool) -> Found:
    """Blocks, or whole records, as new experiments for a fit to the rest."""
    blocks = _blocks(subject, folds)
    results = parallel_map(
        lambda block: _held_out(subject, block),
        blocks,
        workers=workers,
        progress=progress,
        description="folds",
    )
    order = np.concatenate([block[0] for block in blocks])
    elpd = np.concatenate([one[0] for one in results])
    k = np.concatenate([np.full(len(one[0]), one[1]) for one in results])
    error = float(np.sqrt(sum(one[2] ** 2 for one in results)))
    base = Base.of(subject)
    lppd = sum(float(_chain(base, subject.fresh(*block[1]))[0].sum()) for block in blocks)
    found = Found(base, order, elpd, k, lppd, error, refits=len(blocks))
    _note(found, subject)
    found.left = int((k > good_k(len(base.log_weights))).sum())
    return found


Block = tuple[np.ndarray, tuple[int, int, int]]


def _blocks(subject: Subject, folds: int) -> list[Block]:
    """Samples of each block, and its record and range."""
    places = subject.places
    records = np.unique(places["record"])
    found = []
    if len(records) > 1:
        for r in records:
            own = np.flatnonzero(places["record"] == r)
            found.append((own, (int(r), 0, int(places["sample"][own].max()) + 1)))
        return found
    n = int(places["sample"].max()) + 1
    if not isinstance(folds, int) or not 2 <= folds <= n // 2:
        raise invalid("folds", expected=f"a whole number from 2 to {n // 2}", got=repr(folds))
    edges = np.linspace(0, n, folds + 1).astype(int)
    for first, last in itertools.pairwise(edges):
        own = np.flatnonzero((places["sample"] >= first) & (places["sample"] < last))
        if len(own):
            found.append((own, (0, int(first), int(last))))
    return found


def _held_out(subject: Subject, block: Block) -> tuple[np.ndarray, float, float]:
    own, where = block
    left_out = np.zeros(len(subject.places["sample"]), dtype=bool)
    left_out[own] = True
    other = subject.without(left_out)
    base = Base.of(other)
    elpd, error = _chain(base, other.fresh(*where))
    return elpd, base.k, error


def _chain(base: Base, step: np.ndarray) -> tuple[np.ndarray, float]:
    """Densities (N',) of samples one after the other, each given those before it in the block.

    They add up to the log of the mean density of the whole block, and to its Monte Carlo error.
    """
    log_weights = base.log_weights
    cumulated = log_weights[:, None] + np.cumsum(step, axis=1)
    joint = logsumexp(cumulated, axis=0)
    weight = np.exp(log_weights)
    error = spread_of(np.exp(cumulated[:, -1] - joint[-1]) - weight, base.ancestor)
    return np.diff(joint, prepend=logsumexp(log_weights)), error


def _note(found: Found, subject: Subject) -> None:
    if not found.base.corrected:
        found.notes.append(
            f"Pareto's k of the posterior itself is {found.base.k:.2f}: its draws are taken as "
            "they are, without the ratios p/q."
        )
    if "at each optimum" in subject.draws.kind:
        found.notes.append(
            "Poles, gains, noise and lengthscales are at their optimum, fitted to all data: "
            "fit with method='importance' (the default along 1000 samples or fewer) or 'nuts', or "
            "use target='new record', to count what they cost."
        )
