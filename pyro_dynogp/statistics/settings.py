"""Every threshold of the closed loop, each with its meaning and what speaks for its value."""

from __future__ import annotations

from dataclasses import dataclass, fields

from pyro_dynogp.support.errors import COUNT, POSITIVE, invalid
from pyro_dynogp.support.shown import shown


@shown
@dataclass(frozen=True)
class LoopSettings:
    """Thresholds of `close_loop`; the defaults are those of all published counts.

    Attributes:
        gain: least gain of held-out log density by which an effect is added [nats].
            Evidence: convention of cross-validation; half and double of it judge none of 114
            stored refits otherwise (docs/measurements.md).
        standard_errors: block standard errors that such a gain must exceed.
            Evidence: coverage of the error under autocorrelation is measured in the tests of
            `criticism.comparison`; 1 and 3 judge 9 and 6 of 114 stored refits otherwise.
        unsure, unsure_errors: p-value of the test beyond which such a gain must exceed so many
            block standard errors; and false discovery rate up to which a gain is settled on the
            whole record, or a pair refitted. Evidence: of 734 effects named in 924 planted records
            7 right and 13 wrong ones had larger p-values (docs/planted).
        nearly: block standard errors from which a gain that is not enough is called nearly so.
            Evidence: convention: of gains of nothing 4 % lie between 1.5 and 2 errors.
        cap: most that one sample counts for where the plain sum is not certain [nats].
            Evidence: reason: an outlier makes the standard error as large as the sum; half and
            double of it judge none of 114 stored refits otherwise.
        special: share of a gain that a special case of an effect may lack and still be named.
            Evidence: reason: what is left are differences of fits; half and double of it name
            the same effect for all 114 stored refits.
        harm: share of the mean absolute error of forecasts that an effect may cost.
            Evidence: reason: other weights of samples move a model a little; half and double of
            it judge none of 114 stored refits otherwise, of which those of the noise had errors.
        outside: how many times as much a cause outside the catalogue must explain before an effect
            is doubted. Evidence: counted once, by an earlier version whose rows are not kept: of 15
            development plants with an effect of the catalogue it explained at most 1.03 times as
            much, of 14 without one 9 more than twice; half and double of it doubt none of 21
            otherwise (docs/measurements.md).
        relative: largest p-value at which an effect is refitted because a relative's test rejects.
            Evidence: half and double of it add the same effect to 21 stored records.
        gate: share of `level` for each of the two answers to whether anything is left.
            Evidence: two tests, Bonferroni.
        worse: ratio of errors after to before from which effects do harm: on the last block (by
            RMSE or CRPS, the other not better by as much), so that the report keeps the model
            before; and of a line in time to the last level held (by RMSE), beyond which it is not
            added. Evidence: reason: effects of the noise change scores by chance.
        worse_errors: standard errors of a loss of log density on the last block from which effects
            do harm. Evidence: convention.
        level_samples: over which the last level is averaged that a drift is held at.
            Evidence: reason: white noise of ten samples averages to a third.
        block_samples: fewest samples of the block that is searched and of the one reported on.
            Evidence: none.
        measured_samples: fewest measured samples of those blocks, and of whatever is tested.
            Evidence: reason: a filter of order three is all that as many tell.
        fit_share, search_share: shares of a record that is cut anew for the fit and the search.
            Evidence: none.
        stretches: of the searched block where it is shared between fit and search.
            Evidence: none.
        folds: blocks of the record on which effects of one instant are scored.
            Evidence: none.
        refinements: sizes of steps by which the best variant of an effect is refined.
            Evidence: cost.
        reach: times the longest delay of the first variants that a refined one may come to.
            Evidence: reason: variants are compared on the same samples.
        settled: time constants until a simulation from an unknown state has settled.
            Evidence: exp(-4) = 2 % of the first state is left.
        settling_share: most of a record that may be lost to that.
            Evidence: none.
        draws: posterior draws that say what parameter uncertainty leaves in a residual.
            Evidence: cost.
        replicates: most of a residual without the effect, for each p-value.
            Evidence: size under white, coloured and resonant noise (docs/measurements.md).
        fewest_replicates: where records are long, and each replicate takes long.
            Evidence: cost.
        exceedances: replicates beyond the statistic, below which a fitted tail gives the p-value;
            no more are made once there are as many.
            Evidence: reason: a count of ten is known to a third of itself.
        filter_order: highest order of an autoregressive filter of the residual.
            Evidence: none.
        noticed: largest p-value at which limits, widths and delays are looked for more finely.
            Evidence: cost.
        preference: gain of one more parameter (a delay, an instant, another clock) by which it is
            named rather than the simpler cause [nats].
            Evidence: half and double of it name another place in 1 and 1 of 18 pieces of evidence.
        tied: largest p-value of equal values at an end of the output that are called a limit.
            Evidence: none.
        flat: largest slope beyond a limit, as a share of that before it.
            Evidence: reason: what goes on rising is no limit.
        step_margin, clock_margin: share of the record at each end where no level shift, and no
            change of a clock, is looked for. Evidence: reason: too short to tell a level.
        days_for_hours, days_for_week, days_for_year: fewest days of a record for contrasts of the
            hours, of the week, of the year. Evidence: reason: fewer do not repeat them.
        cycles: fewest periods in a record of a disturbance that is called periodic.
            Evidence: reason: what is slower is drift.
        harmonic: level of the test of each harmonic, all together. Evidence: convention.
        outlier: probability that normal errors have an outlier anywhere. Evidence: convention.
        controller: share of an input's variance, less what its past and a set point foretell, below
            which it is computed from the output. Evidence: 300 records without feedback, with 1 %
            noise and three of four with a direct path, have 1.3e-4 or more; PI and PID controllers
            1e-12 or less, with three decimals 1e-6 (tests).

    Raises:
        ValueError: on a number that is not positive.

    Examples:
        >>> strict = dgp.LoopSettings(gain=8.0, standard_errors=3.0)
        >>> strict.gain, strict.level_samples
        (8.0, 10)
    """

    gain: float = 4.0
    standard_errors: float = 2.0
    unsure: float = 0.01
    unsure_errors: float = 3.0
    nearly: float = 1.5
    cap: float = 10.0
    special: float = 0.05
    harm: float = 0.05
    outside: float = 2.0
    relative: float = 0.3
    gate: float = 0.5
    worse: float = 1.05
    worse_errors: float = 2.0
    level_samples: int = 10
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
    replicates: int = 200
    fewest_replicates: int = 60
    exceedances: int = 10
    filter_order: int = 24
    noticed: float = 0.1
    preference: float = 3.0
    tied: float = 0.01
    flat: float = 0.3
    step_margin: float = 0.03
    clock_margin: float = 0.05
    days_for_hours: int = 3
    days_for_week: int = 14
    days_for_year: int = 548
    cycles: float = 3.0
    harmonic: float = 0.01
    outlier: float = 0.05
    controller: float = 1e-5

    def __post_init__(self) -> None:
        for entry in fields(self):
            rule = COUNT if isinstance(entry.default, int) else POSITIVE
            rule.check(entry.name, getattr(self, entry.name))
        if self.fit_share + self.search_share >= 1.0:
            got = f"{self.fit_share + self.search_share:g}"
            raise invalid("fit_share and search_share", expected="a sum below 1", got=got)
