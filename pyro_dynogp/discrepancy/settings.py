"""Every threshold of the closed loop, each with its meaning and what speaks for its value."""

from __future__ import annotations

from dataclasses import dataclass, fields

from pyro_dynogp.support.errors import invalid


@dataclass(frozen=True)
class LoopSettings:
    """Thresholds of `close_loop`; the defaults are those of all published counts.

    Attributes:
        gain: least gain of held-out log density by which an effect is added [nats].
            Evidence: convention of cross-validation; half and double of it judge none of 66
            stored refits otherwise (docs/measurements.md).
        standard_errors: block standard errors that such a gain must exceed.
            Evidence: coverage of the error under autocorrelation is measured in the tests of
            `criticism.comparison`; 1 and 3 judge 8 and 6 of 66 stored refits otherwise.
        cap: most that one sample counts for where the plain sum is not certain [nats].
            Evidence: reason: an outlier makes the standard error as large as the sum; half and
            double of it judge none of 66 stored refits otherwise.
        special: share of a gain that a special case of an effect may lack and still be named.
            Evidence: reason: what is left are differences of fits; half and double of it name
            the same effect for all 66 stored refits.
        harm: share of the mean absolute error of forecasts that an effect of the noise may cost.
            Evidence: reason: other weights of samples move a model a little; half and double of
            it judge none of 66 stored refits otherwise.
        outside: how many times as much a cause outside the catalogue must explain before an effect
            is doubted. Evidence: counted once, by an earlier version whose rows are not kept: of 15
            development plants with an effect of the catalogue it explained at most 1.03 times as
            much, of 14 without one 9 more than twice.
        relative: largest p-value at which an effect is refitted because a relative's test rejects.
            Evidence: none.
        gate: share of `level` for each of the two answers to whether anything is left.
            Evidence: two tests, Bonferroni.
        worse: ratio of scores of the last block from which a report warns.
            Evidence: reason: effects of the noise change scores by chance.
        worse_errors: standard errors of a loss of log density from which a report warns.
            Evidence: convention.
        block_samples: fewest samples of the block that is searched and of the one reported on.
            Evidence: none.
        measured_samples: fewest of them that were measured.
            Evidence: none.
        fit_share, search_share: shares of a record that is cut anew for the fit and the search.
            Evidence: none.
        stretches: of the searched block where it is shared between fit and search.
            Evidence: none.
        folds: blocks of the record on which effects of one instant are scored.
            Evidence: none.
        refinements: how often the best variant of an effect is refined.
            Evidence: cost.
        reach: times the longest delay of the first variants that a refined one may come to.
            Evidence: reason: variants are compared on the same samples.
        settled: time constants until a simulation from an unknown state has settled.
            Evidence: exp(-4) = 2 % of the first state is left.
        settling_share: most of a record that may be lost to that.
            Evidence: none.
        draws: posterior draws that say what parameter uncertainty leaves in a residual.
            Evidence: cost.

    Raises:
        ValueError: on a number that is not positive.
    """

    gain: float = 4.0
    standard_errors: float = 2.0
    cap: float = 10.0
    special: float = 0.05
    harm: float = 0.05
    outside: float = 2.0
    relative: float = 0.3
    gate: float = 0.5
    worse: float = 1.05
    worse_errors: float = 2.0
    block_samples: int = 60
    measured_samples: int = 30
    fit_share: float = 0.5
    search_share: float = 0.25
    stretches: int = 6
    folds: int = 12
    refinements: int = 2
    reach: float = 1.3
    settled: float = 4.0
    settling_share: float = 0.1
    draws: int = 48

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not value > 0:
                raise invalid(entry.name, expected="a number > 0", got=repr(value))
        if self.fit_share + self.search_share >= 1.0:
            got = f"{self.fit_share + self.search_share:g}"
            raise invalid("fit_share and search_share", expected="a sum below 1", got=got)


DEFAULTS = LoopSettings()
