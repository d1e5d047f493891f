"""The model-selection hook: elpd of data that were left out, for the target that the user names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np

from pyro_dynogp.criticism import arviz_bridge
from pyro_dynogp.criticism.left_out import Found, forecast, missing_sample, new_record
from pyro_dynogp.criticism.posterior_draws import DRAWS
from pyro_dynogp.criticism.subjects import FitSubject, Parameters, Subject
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import as_records
from pyro_dynogp.inference.fitted import Fitted, known_fit
from pyro_dynogp.inference.isolation import isolated
from pyro_dynogp.inference.pareto import good_k
from pyro_dynogp.support.errors import invalid

Target = Literal["missing sample", "forecast", "new record"]
TARGETS = get_args(Target)
# Refits that are made without being asked for more.
MOST_REFITS = 30


@isolated
def loo(
    fit: Fitted | Subject,
    record: Record | Sequence[Record] | None = None,
    *,
    target: Target,
    horizon: int = 1,
    begin: int | float = 0.5,
    folds: int = 5,
    draws: int = DRAWS,
    parameters: Parameters = "posterior",
    refits: int = MOST_REFITS,
    seed: int = 0,
    workers: int | None = None,
    progress: bool = True,
) -> Any:
    """Expected log predictive density of data that the model has not seen, as ArviZ's ELPDData.

    There is no default target, since the answers differ: a smooth signal is far easier to fill in
    than to forecast. Densities are those of outputs in their own units, with trajectories
    integrated out.

    Args:
        fit: a fit, or another `Subject` (`dgp.from_pyro` makes one of any Pyro model).
        record: the training record(s), by default those of the fit.
        target: "missing sample", each output given all others, before and after (leave-one-out);
            "forecast", each output given those at least `horizon` samples before
            (leave-future-out); "new record", blocks of the record, or whole records where there
            are several, as new experiments with unknown first state (K-fold).
        horizon: of "forecast" [samples].
        begin: of "forecast": first sample that is scored, a number of samples or a share of the
            record.
        folds: of "new record", contiguous blocks of a single record.
        draws: of the posterior; of fits by importance or NUTS those that the fit holds, which
            `check` and every target take.
        parameters: "posterior", or "mode" for densities with all parameters at the mode, which has
            seen the data: O(n) and quick, and kind to models of many parameters. For records so
            long that parameters are all but known.
        refits: most fits that are made again where Pareto's k is above ArviZ's good_k. Forecasts
            begin with a fit to the past of the first one, and go on from it by ratios that take in
            what came since. Where these fail draws of all parameters are moved to more data, which
            counts as a refit, as where a model with static functions leaves single samples out; 0
            has forecasts take the future out of the draws given all data, which flatters. "new
            record" makes one for each fold whatever this says.
        seed: for the draws. workers: processes for refits. progress: whether to show a bar.

    Returns:
        ELPDData with ArviZ's entries (elpd_loo, se, p_loo, pareto_k, loo_i, ...) and: `target`,
        `horizon`, `data` (fingerprint), `draws_from`, `drawn` (the parameters whose uncertainty
        is counted; ``print`` says it, too), `posterior_k` (Pareto's k of the draws
        themselves), `corrected` (whether ratios p/q enter: not where posterior_k is too high),
        `monte_carlo_error` of elpd_loo [nats], `refits`, `not_refitted`, `notes`. `loo_i` has the
        coordinates record, sample and output. `se` takes samples as independent: `compare` has
        standard errors that do not.

    Raises:
        ValueError: on an unknown target, on a record that the fit was not trained on, on models
            whose densities given other samples are not known.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> quick = {"method": "map", "restarts": 1, "workers": 1, "progress": False}
        >>> fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **quick)
        >>> options = {"draws": 100, "refits": 0, "workers": 1, "progress": False}
        >>> elpd = dgp.loo(fit, target="missing sample", **options)
        >>> elpd.n_data_points, elpd["target"]
        (60, 'missing sample')
    """
    if target not in TARGETS:
        raise invalid(
            "target",
            expected=f"one of {list(TARGETS)}",
            got=repr(target),
            advice="Name what the model is for: filling gaps, forecasting, or new experiments.",
        )
    subject = subject_of(fit, record, draws, seed, parameters, progress)
    if target == "missing sample":
        found = missing_sample(subject, refits, workers, progress)
    elif target == "forecast":
        found = forecast(subject, horizon, begin, refits, progress)
    else:
        found = new_record(subject, folds, workers, progress)
    return _elpd(subject, found, target, horizon)


def subject_of(
    fit: Any,
    record: Record | Sequence[Record] | None,
    draws: int,
    seed: int,
    parameters: Parameters = "posterior",
    progress: bool = False,
) -> Subject:
    """What `loo` works on."""
    if not isinstance(fit, Fitted):
        if not all(hasattr(fit, name) for name in ("draws", "pointwise", "places", "data")):
            raise invalid("fit", expected="a Fit, or a Subject", got=type(fit).__name__)
        return fit
    known_fit(fit)
    records = fit.records if record is None else as_records(record)
    if record is not None:
        fit.model.check(records)
    unknown = [one.name for one in records if one.fingerprint not in fit.training]
    if unknown or len(records) != len(fit.records):
        raise invalid(
            "record",
            expected="the training record(s), all of them",
            got="others",
            advice="Data that the fit has not seen are scored directly: dgp.scores, or "
            "fit.log_likelihood.",
        )
    if parameters not in ("posterior", "mode"):
        raise invalid("parameters", expected="'posterior' or 'mode'", got=repr(parameters))
    return FitSubject(fit, fit.records, draws, seed, parameters, progress)


def _drawn(subject: Subject) -> str:
    """The parameters whose uncertainty is counted, in words."""
    if isinstance(subject, FitSubject) and subject.parameters == "mode":
        return "no parameter: all are at the mode"
    if "at each optimum" in subject.draws.kind:
        return "inducing values and first states alone"
    return "all parameters"


def _elpd(subject: Subject, found: Found, target: str, horizon: int) -> Any:
    count = len(subject.draws)
    if found.left:
        found.notes.append(
            f"Samples with a Pareto k above {good_k(count):.2f} that were not fitted again: "
            f"{found.left}. Raise `refits`, or use target='new record'."
        )
    order = np.argsort(found.index)
    return arviz_bridge.elpd_data(
        found.elpd[order],
        found.k[order],
        lppd=found.lppd,
        draws=count,
        warning=bool(found.left or found.notes),
        coords={name: value[found.index[order]] for name, value in subject.places.items()},
        extra={
            "target": target,
            "horizon": horizon,
            "data": subject.data,
            "draws_from": subject.draws.kind,
            "drawn": _drawn(subject),
            "posterior_k": found.base.k,
            "corrected": found.base.corrected,
            "monte_carlo_error": found.error,
            "refits": found.refits,
            "not_refitted": found.left,
            "notes": tuple(found.notes),
        },
    )
