"""What a search says of itself: that time ended it, what process noise hid, what forecasts miss."""

from __future__ import annotations

from pyro_dynogp.discrepancy.decision import LATE
from pyro_dynogp.discrepancy.state import SearchState
from pyro_dynogp.models.variants import has_process_noise


def said_of_time(course: SearchState) -> list[str]:
    """That the search ended early, and what was not tried."""
    if not course.early:
        return []
    said = f"The search ended early: the time limit of {course.watch.limit:g} s was passed"
    if course.number == 0:
        return [f"{said} before the first round. No residual was tested."]
    if course.looked is None:
        return [f"{said} after round {course.number}. What the model leaves since then was not "
                "tested."]  # fmt: skip
    own = [one for one in course.attempts if one.round == course.number]
    parts = [f"{said} in round {course.number}, which added nothing."]
    for words, decision in (("Not refitted", "not tried"), ("Not decided", "undecided")):
        names = dict.fromkeys(
            one.name for one in own if one.decision == decision and one.reason.endswith(LATE)
        )
        if names:
            parts.append(f"{words}: {', '.join(names)}.")
    return [" ".join(parts)]


def said_of_hiding(course: SearchState) -> list[str]:
    """That process noise hides what is missing, and what was done about it."""
    if not course.hidden:
        return []
    if not has_process_noise(course.first.model):  # it is in some layers only
        done = "Fit it with process_noise=False, and close the loop on that."
    elif course.dropped:
        ways = "with or without it" if course.returned else "without it"
        done = f"Nothing was found to add {ways}."
    elif course.returned:
        done = "The search without it found nothing to add, and began again with it."
    elif not course.added:
        done = "The search began without it."
    else:
        back = has_process_noise(course.current.model)
        done = "The search began without it, and the extended model " + (
            "has it again: there it costs nothing." if back else "does without it."
        )
    return [f"The model as given {course.hidden}: such noise can hide what is missing. {done}"]


def said_of_misses(course: SearchState) -> list[str]:
    """That forecasts miss by far more than the noise, where no test tells why."""
    if not course.misses:
        return []
    why = "One step ahead the model takes it for process noise. "
    if not has_process_noise(course.current.model):
        why = ""
    return [
        f"{course.misses} {why}No residual test is certain of an effect there, and none that was "
        "refitted helps for certain."
    ]
