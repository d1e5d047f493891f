"""The course of a loop: what its rounds have come to so far, and what the next one makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import isnan
from typing import TYPE_CHECKING

from pyro_dynogp.discrepancy.context import Left, SearchContext, Stopwatch, Tested
from pyro_dynogp.discrepancy.data_faults import spikes_of
from pyro_dynogp.discrepancy.decision import Confirmed
from pyro_dynogp.discrepancy.elimination import Added, is_superfluous, withdrawn, without
from pyro_dynogp.discrepancy.forecast_misses import forecast_misses
from pyro_dynogp.discrepancy.result import Attempt, EffectTest, Outcome
from pyro_dynogp.discrepancy.search import Candidate, Found, candidates_of, extended_by
from pyro_dynogp.effects.base import OUTSIDE
from pyro_dynogp.models.variants import Model, has_process_noise
from pyro_dynogp.statistics.controllers import SET

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

FED_BACK = "inputs are under feedback, for which the residual speaks more clearly"
OTHERS = "others are more probable"
NO_BLOCK = "no block of the model stands for it"
ANY = "any structure"
SET_POINT = "it is the set point of a controller, and acts through the input alone"
OVER = "the most effects that may be added are added"
EXPLAINED = (
    "The model leaves nothing of it once it is fitted to the block that was searched as well: "
    "before, its parameters were not known well enough there. report.fit is fitted to both blocks."
)


@dataclass(eq=False)
class SearchState:
    """What rounds have come to.

    Where process noise hides what is missing, rounds begin without it. It comes back as soon as it
    costs nothing; and where nothing can be added without it, rounds begin again with it: what it
    takes up may be all that keeps a fit from explaining it by dynamics that run away.

    Attributes:
        rounds: what they have in common. watch: where the time goes.
        first: fit of the model as given. plain: of that model without process noise.
        current: fit of the model so far. model: that model.
        hidden: in words, that process noise hides what is missing; empty where it does not.
        quiet: whether process noise is taken away until it costs nothing.
        returned: whether rounds began again with it.
        number: of rounds so far.
        added: effects in order.
        eliminated: names of effects that later ones have made superfluous.
        attempts: what was tried. tests: all tests, whatever came of them.
        reported: what no block mends, by the last tests.
        rest: what is left by the last tests. notes: what else there is to say.
        misses: in words, that forecasts miss by far more than the noise, where tests say nothing.
        early: whether the time limit was passed before the search came to its end.
        left_without: what is left without process noise, where rounds began again with it.
        looked: what the last tests saw; None where the model has changed since.
    """

    rounds: SearchContext
    watch: Stopwatch
    first: Fit
    plain: Fit = field(init=False)
    current: Fit = field(init=False)
    model: Model = field(init=False)
    hidden: str = field(init=False)
    quiet: bool = False
    returned: bool = False
    number: int = 0
    added: list[Added] = field(default_factory=list)
    eliminated: list[str] = field(default_factory=list)
    attempts: list[Attempt] = field(default_factory=list)
    tests: list[EffectTest] = field(default_factory=list)
    reported: list[Found] = field(default_factory=list)
    rest: Left = field(default_factory=Left)
    misses: str = ""
    notes: list[str] = field(default_factory=list)
    early: bool = False
    left_without: tuple[str, ...] = ()
    looked: Tested | None = None

    def __post_init__(self) -> None:
        self.plain = self.rounds.plain(self.first)
        self.hidden = self.rounds.hiding(self.first, self.plain)
        self._go_on_from(self.first)
        if self.hidden and has_process_noise(self.first.model):
            self._go_on_from(self.plain)
            self.quiet = True

    def go_round(self) -> bool:
        """Look, try what the residual speaks for, and add what helps; whether to go on."""
        self.number += 1
        looked, rounds = self.look(), self.rounds
        if self.number == 1:
            self.notes += spikes_of(looked.residuals, rounds.data.known, rounds.settings)
            self.notes += looked.notes
        chosen = self._chosen(looked)
        attempts = self._untried(looked.found, chosen, OTHERS)
        given = chosen, self.current, self.number, not self.rest.said
        confirmed = rounds.confirm(*given) if chosen else None
        if confirmed is not None:
            self.watch.stop("refits")
            attempts += confirmed.attempts
            self.early = confirmed.early
        self._list(looked.found, attempts)
        if confirmed is not None and confirmed.winner is not None:
            self._add(confirmed.winner, confirmed, looked)
            return True
        if not (self.rest.said and self.quiet) or self.added or self.early:
            return False
        self.left_without = self.rest.said
        self._go_on_from(self.first)
        self.quiet, self.returned = False, True
        return True

    def go_rounds(self, most: int) -> None:
        """Go rounds until nothing helps, as many effects are added as may be, or time is over."""
        while not self.stopped() and self.go_round():
            if len(self.added) == most:  # whether something is left is still to be said
                if not self.stopped():
                    self.number += 1
                    self._list(found := self.look().found, self._untried(found, [], OVER))
                break
        if not self.early:
            self.explain()
            self.doubt()

    @property
    def accepted(self) -> list[tuple[Found, Confirmed]]:
        """Effects that were added, in order, and what refits said of them."""
        return [(one.found, one.confirmed) for one in self.added]

    @property
    def fits(self) -> list[Fit]:
        """With each effect and those before; or that without process noise, which was dropped."""
        return [self.plain] if self.dropped else [one.fit for one in self.added]

    @property
    def dropped(self) -> bool:
        """Whether nothing was added, and the last fit is the model without its process noise."""
        return (self.quiet or self.returned) and not (self.added or self.early)

    def stopped(self) -> bool:
        """Whether the time limit was passed before the search came to its end."""
        self.early = self.early or self.watch.late()
        return self.early

    def look(self) -> Tested:
        """Test the residuals of the model so far."""
        plain = None if self.added else self.plain
        looked = self.rounds.look(self.current, self._known(self.quiet), plain)
        # Of the last tests: what a model lacks may look like what no block mends (feedback).
        self.reported = [
            f for f in looked.found if not f.effect.added and f.q_value <= self.rounds.gate
        ]
        rounds = self.rounds
        self.rest = rounds.left(looked)
        if not self.rest.said:
            self.misses = forecast_misses(self.current, rounds.data.known, rounds.held_out)
        self.looked = looked
        self.watch.stop("residual tests")
        return looked

    def explain(self) -> None:
        """Take back what is left, where the model leaves nothing once it is fitted to block B.

        Of linear models: refits of others take as long as a round (26 of 130 s for one function of
        380 samples), and what their parameters would learn is not in their one-step errors.
        """
        if self.reported or self.current.model.has_function:  # what is reported no fit mends
            return
        rounds = self.rounds
        said: list[str] = []
        if self.rest.said and rounds.explained(self.current, self._known(self.quiet)):
            said += self.rest.said
            self.rest = replace(self.rest, said=())
        if self.left_without and rounds.explained(self.plain, self._known(quiet=True)):
            said += self.left_without
            self.left_without = ()
        self.notes += [f"{one} {EXPLAINED}" for one in dict.fromkeys(said)]
        self.watch.stop("residual tests")

    def doubt(self) -> None:
        """Add a cause outside the catalogue as a tie, where what is left explains far more."""
        if not (self.added and self.rest.said and self.looked):
            return
        beyond = self.rounds.beyond(self.looked.whole)
        self.added = [
            self._doubted(one)
            if OUTSIDE not in one.confirmed.ties
            and self.rounds.doubtful(one.found, one.seen, beyond)
            else one
            for one in self.added
        ]
        self.watch.stop("residual tests")

    def _known(self, quiet: bool) -> set[str]:
        """Names of effects that are not looked for: those that are added, and what goes with them.

        Args:
            quiet: whether process noise is taken away.
        """
        known = {one.effect.name for one, _ in self.accepted}
        if quiet:
            known |= {one.name for one in self.rounds.effects if one.absorbs_structure}
        # A function of the output that is there has its limits, too.
        return known | {one.name for one in self.rounds.effects if one.special_of in known}

    def _is_fed_back(self, found: Found) -> bool:
        """Whether inputs under feedback make an effect: it goes with them, and is less certain.

        Inputs that follow the output's disturbances are among what explains the residual, whatever
        the model is. (What a model lacks may look like feedback, but less than like itself.)
        """
        certain = [f.evidence.p_value for f in self.reported if SET not in f.evidence.where]
        return (
            bool(certain)
            and found.effect.mimicked_by_feedback
            and found.evidence.p_value > min(certain)
        )

    def _is_set_point(self, found: Found) -> bool:
        """Whether an effect comes from the set point of a controller that computes an input."""
        where = found.evidence.where
        points = {f.evidence.where[SET] for f in self.reported if SET in f.evidence.where}
        return SET not in where and where.get("channel") in points

    def _chosen(self, looked: Tested) -> list[Candidate]:
        """Effects that are worth a refit, where anything is left, or forecasts miss."""
        rounds = self.rounds
        if not (self.rest.said or self.misses):
            return []
        open_loop = [f for f in looked.found if not (self._is_fed_back(f) or self._is_set_point(f))]
        return candidates_of(
            open_loop, self.model, rounds.data.known, rounds.level, rounds.tries, rounds.settings
        )

    def _list(self, found: Sequence[Found], attempts: Sequence[Attempt]) -> None:
        """Keep what was tried in a round, and every test of it."""
        self.attempts += attempts
        decided: dict[int, Outcome] = {id(one.evidence): one.decision for one in attempts}
        for f in found:
            one, level = f.evidence, self.rounds.level
            passed = bool(self.rest.said or self.misses) and one.p_value <= level
            otherwise: Outcome = "not tried" if passed else "not significant"
            decision: Outcome = decided.get(id(one), otherwise)
            test = EffectTest(
                self.number, one.effect, one.output, one.place, one.p_value, f.q_value, decision
            )
            self.tests.append(test)
        names = self.rounds.data.known.output_names
        self.tests += [
            EffectTest(
                self.number, ANY, name, "", p, p,
                "reported" if p <= self.rounds.gate else "not significant",
            )
            for name, p in zip(names, self.rest.p_values, strict=False) if not isnan(p)
        ]  # fmt: skip

    def _untried(
        self, found: Sequence[Found], chosen: Sequence[Candidate], why: str
    ) -> list[Attempt]:
        """Effects that the residual speaks for, but that were not refitted, for a reason."""
        tried = [one for one, _ in chosen]
        attempts = []
        for f in found:
            if f.q_value > self.rounds.level or any(f is one for one in tried):
                continue
            variants, refused = extended_by(f, self.model, self.rounds.data.known)
            reason = refused or (why if variants else NO_BLOCK)
            attempt = Attempt(self.number, f.evidence, f.q_value, "not tried", reason)
            if not f.effect.added:
                attempt = replace(attempt, decision="reported", reason="is reported, not added")
            elif self._is_set_point(f):
                attempt = replace(attempt, reason=SET_POINT)
            elif self._is_fed_back(f):
                attempt = replace(attempt, reason=FED_BACK)
            attempts.append(attempt)
        return attempts

    def _add(self, winner: Found, confirmed: Confirmed, looked: Tested) -> None:
        """Go on with the model that a winner extends."""
        rounds, larger = self.rounds, confirmed.model
        assert larger is not None
        base = self.current
        self.watch.stop("residual tests")
        again = rounds.hold_out_less(winner)
        fit = confirmed.fit
        if fit is None or again:
            fit = rounds.refit(base, larger)
        if self.quiet and (noisy := rounds.with_process_noise(fit)) is not None:
            fit, self.quiet = noisy, False
        one = Added(winner, confirmed, looked.whole, base, fit)
        if rounds.doubtful(winner, looked.whole, rounds.beyond(looked.residuals)):
            one = self._doubted(one)
        self.added.append(one)
        self._eliminate()
        self._go_on_from(self.added[-1].fit)
        self.watch.stop("refits")

    @staticmethod
    def _doubted(one: Added) -> Added:
        """With a cause outside the catalogue as a tie."""
        return replace(one, confirmed=replace(one.confirmed, ties=(*one.confirmed.ties, OUTSIDE)))

    def _eliminate(self) -> None:
        """Take out what the effect added last has made superfluous, each kind of effect once."""
        rounds, last = self.rounds, self.added[-1].found.effect.name
        for one in self.added[-2::-1]:
            name = one.found.effect.name
            if name in self.eliminated or self.stopped():
                continue
            left = without(self.added, self.added.index(one), rounds.refit)
            if left is None or not is_superfluous(
                one, self.added[-1].fit, left[-1].fit, rounds.data.known, rounds.held_out,
                rounds.settings,
            ):  # fmt: skip
                continue
            self.added = left
            self.eliminated.append(name)
            self.attempts, self.tests = withdrawn(self.attempts, self.tests, one, last)
            self.notes.append(f"{name} is superfluous next to {last}, and was taken out again.")

    def _go_on_from(self, fit: Fit) -> None:
        self.current, self.model = fit, replace(fit.model, scaling=None)
        self.rest, self.misses, self.looked = Left(), "", None  # they were of another model
