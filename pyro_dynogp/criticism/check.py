"""Whether a posterior is to be trusted, on one screen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
import pyro
import torch

from pyro_dynogp.criticism.calibration import calibration
from pyro_dynogp.criticism.finding import Finding, apart
from pyro_dynogp.criticism.leave_future_out import forecast_findings
from pyro_dynogp.criticism.posterior_draws import DRAWS, draws_of
from pyro_dynogp.criticism.twin import twin_findings
from pyro_dynogp.inference.fitted import known_fit
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.inference.log_joint import log_joint_of
from pyro_dynogp.inference.pareto import good_k, psis
from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from pyro_dynogp.inference.stability import of_numbers, of_poles
from pyro_dynogp.prediction.predict import predict
from pyro_dynogp.support.parallel import parallel_map
from pyro_dynogp.support.shown import shown

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted

# Largest R-hat and fewest effective draws of chains that have mixed (Vehtari et al. 2021).
R_HAT, EFFECTIVE = 1.01, 400
# An optimum is found again where another start comes this close [nats].
SAME = 2.0


@shown
@dataclass(repr=False, frozen=True)
class Check:
    """What `check` found.

    Attributes:
        findings: in order. method: of the fit.
    """

    findings: tuple[Finding, ...]
    method: str

    @property
    def good(self) -> bool:
        """Whether nothing speaks against the fit."""
        return all(finding.good is not False for finding in self.findings)

    @property
    def verdict(self) -> str:
        """One sentence."""
        bad = [finding.name for finding in self.findings if finding.good is False]
        if not bad:
            return "No check found anything against this fit."
        return f"Look again at: {', '.join(bad)}."

    def __getitem__(self, name: str) -> Finding:
        for finding in self.findings:
            if finding.name == name:
                return finding
        raise KeyError(name)

    def __str__(self) -> str:
        mark = {True: "good", False: "BAD", None: ""}
        width = max(len(finding.name) for finding in self.findings)
        lines = [
            f"{finding.name:<{width}}  {mark[finding.good]:<4}  {finding.number:>8}  {finding.text}"
            for finding in self.findings
        ]
        return "\n".join([f"Check of a fit by {self.method}", *lines, self.verdict])


@isolated
def check(
    fit: Fitted,
    *,
    twin: int | Literal[False] = False,
    forecasts: bool = True,
    draws: int = DRAWS,
    seed: int = 0,
    workers: int | None = None,
    progress: bool = True,
) -> Check:
    """Check the posterior of a fit, its one-step predictions and forecasts of the training record.

    - Pareto's k of the posterior (Yao, Vehtari, Simpson & Gelman 2018), with trajectories
      integrated out: below 0.5 the approximation is close to the posterior, up to good_k it can
      be corrected by importance weights, above it is another distribution. For "map" it is that of
      Laplace's approximation: whether the posterior is near a normal at all. Where trajectories are
      sites also that of the whole vector, high in many dimensions even where margins are good.
    - NUTS: R-hat, effective draws, divergences.
    - ELBO: whether it still rose at the end. Starts: whether another one came to the same optimum.
    - Poles: those that hardly decay within the record, and records of unstable plants. Numbers:
      nearly as many in a model with functions as there are outputs.
    - One-step predictions: calibrated on the training record (see `calibration`).
    - Forecasts: of later parts of the training record by refits to what came before them (see
      `leave_future_out`). What holds one step ahead need not hold in a free run.
    - With `twin`: a fit of the same model, scaling and method to the first samples alone (from the
      optima of this fit), against NUTS on them. Means of the sites (unconstrained: logarithms of
      scales) are good within 0.5 of NUTS's sds and sds within a factor 1.5, the worst site
      counting; means of one-step predictions within 0.2 of the predictive sd and sds within a
      factor 1.2, in root mean square. What NUTS's chains do not agree on is not judged. Chains
      start around the same optimum, so that one far away shows in `start_energies` alone.

    Args:
        fit: the fit.
        twin: False, or the number of samples of the twin; 100 to 200 are a compromise. NUTS takes
            about four minutes of one core for 120 samples and a linear model of one pair.
        forecasts: whether to fit twice more, to parts of the record, and forecast the rest.
        draws: for Pareto's k, by default those that `loo` takes. seed: for them and for NUTS.
        workers: processes for NUTS's chains. progress: whether to show bars.

    Raises:
        ValueError: where the fit does not know its training records; on a twin of a fit with
            trajectories as sites or by NUTS, or of fewer than 20 or more samples than there are.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
        >>> fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **quick)
        >>> found = dgp.check(fit, forecasts=False, draws=100, workers=1, progress=False)
        >>> print(found["one-step calibration"].name)
        one-step calibration
    """
    known_fit(fit)
    compared: list[Finding] = []
    if twin is not False:  # first: this is where it may be refused
        compared = twin_findings(fit, twin, seed=seed, workers=workers, progress=progress)
    parts: list[Callable[[], Finding | list[Finding]]] = [
        partial(_chains, fit) if fit.method == "nuts" else partial(_posterior, fit, draws, seed)
    ]
    if fit.log_q_sites and fit.trajectories:
        parts.append(partial(_whole_vector, fit))
    if fit.method == "svi":
        parts.append(partial(_elbo, fit))
    parts += [partial(one, fit) for one in (_starts, _warned, _predictions)]
    findings: list[Finding] = []
    for found in parallel_map(
        lambda part: part(), parts, workers=1, progress=progress, description="posterior"
    ):
        findings += [found] if isinstance(found, Finding) else found
    if forecasts:
        findings += forecast_findings(fit, seed=seed, progress=progress)
    findings += compared
    return Check(tuple(findings), fit.method)


def _posterior(fit: Fitted, draws: int, seed: int) -> Finding:
    own = draws_of(fit, count=draws, seed=seed, anneal=False)
    k = float(psis(own.log_ratio)[1])
    good = good_k(len(own))
    found, limit = apart(k, good)
    if not np.isfinite(k) or k > good:
        text = (
            f"{own.kind}: not the posterior's shape, k = {found} (good: up to {limit}); do not "
            "read parameters' bands off it, compare with method='nuts'"
        )
        return Finding("posterior k", k, False, text, good)
    if k > 0.5:
        text = f"{own.kind}: usable with importance weights (up to k = {limit})"
        return Finding("posterior k", k, True, text, good)
    return Finding("posterior k", k, True, f"{own.kind}: close to the posterior", good)


def _whole_vector(fit: Fitted) -> Finding:
    """Trajectories as sites: the ratio of all that the guide draws."""
    values = {**fit.draws, **fit.trajectories}
    argument = fit.records[0] if len(fit.records) == 1 else fit.records
    samples = sum(len(record) for record in fit.records)
    with torch.no_grad(), pyro.poutine.block():
        log_p = log_joint_of(fit.model, (argument,), values, samples)
    log_q = torch.stack(list(fit.log_q_sites.values())).sum(0).numpy()
    ratio = PosteriorDraws(values, log_p, log_q, np.zeros(len(log_q), dtype=int), "").log_ratio
    k = float(psis(ratio)[1])
    text = "all sites together, trajectories too: informs, high in many dimensions"
    return Finding("whole-vector k", k, None, text)


def _chains(fit: Fitted) -> list[Finding]:
    r_hat = {k: v for k, v in fit.diagnostics.items() if k.startswith("r_hat ")}
    ess = {k: v for k, v in fit.diagnostics.items() if k.startswith("effective samples ")}
    worst = max(r_hat, key=lambda name: r_hat[name])
    fewest = min(ess, key=lambda name: ess[name])
    divergences = fit.diagnostics["divergences"]
    share = divergences / max(1, fit.n_draws)
    return [
        Finding(
            "R-hat", r_hat[worst], r_hat[worst] < R_HAT,
            f"largest, of {worst.removeprefix('r_hat ')} (good: below {R_HAT}); pairs that can be "
            "swapped raise it without harm to predictions",
            R_HAT,
        ),
        Finding(
            "effective draws", ess[fewest], ess[fewest] >= EFFECTIVE,
            f"fewest, of {fewest.removeprefix('effective samples ')} (good: {EFFECTIVE} and more)",
        ),
        Finding(
            "divergences", divergences, share <= 0.001,
            "transitions that lost the trajectory (good: none)",
        ),
    ]  # fmt: skip


def _elbo(fit: Fitted) -> Finding:
    """Whether the last fifth of the steps lies above the fifth before it, beyond its noise."""
    history = np.asarray(fit.history)
    if len(history) == 1:  # no course to judge
        text = "of Laplace's approximation, too close for SVI to start, or of a single step"
        return Finding("ELBO", float(history[0]), None, text)
    fifth = max(len(history) // 5, 2)
    last, before = history[-fifth:], history[-2 * fifth : -fifth]
    if len(before) < 2:
        return Finding("ELBO", float(last.mean()), None, "too few steps to tell")
    rise = float(last.mean() - before.mean())
    error = float(np.sqrt(last.var() / len(last) + before.var() / len(before)))
    still = rise > max(1.0, 3.0 * error)
    text = f"rose by {rise:.2f} nats ({error:.2f}) in the last fifth of {len(history)} steps"
    if still:
        text += ": not at its end, raise steps"
    return Finding("ELBO", float(last.mean()), not still, text)


def _starts(fit: Fitted) -> Finding:
    energies = np.asarray(fit.start_energies)
    count = int((energies - energies.min() < SAME).sum())
    if len(energies) == 1:
        return Finding("starts", 1.0, None, "one start: others may lead to better optima")
    text = f"of {len(energies)} came within {SAME:g} nats of the best"
    if count == 1:
        text += ": raise restarts, or look at what another seed gives"
    return Finding("starts", float(count), None, text)


def _warned(fit: Fitted) -> list[Finding]:
    said = {"poles": of_poles(fit), "numbers": of_numbers(fit)}
    return [Finding(name, np.nan, False, one) for name, several in said.items() for one in several]


def _predictions(fit: Fitted) -> list[Finding]:
    findings = []
    for index, record in enumerate(fit.records):
        found = calibration(predict(fit, record), record)
        suffix = f" of record {index}" if len(fit.records) > 1 else ""
        p = float(np.min(found.p_value))
        findings.append(
            Finding(f"one-step calibration{suffix}", p, bool(found.calibrated), found.verdict)
        )
    return findings
