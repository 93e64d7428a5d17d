"""The texts of a report: labels, the headline, the verdict, and how an episode failed."""

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ct_envs.turtlebot3_world import World
from ct_jax.report.pictures import track
from ct_jax.report.reading import Episodes, Place, Run, number

METHOD_LABELS = {
    "ct": "Control Transformer", "bc-ct": "BC-CT", "pt-cql": "PT-CQL", "sac": "SAC alone",
    "planner": "Planner with the full map", "explorer": "Explorer",
}  # fmt: skip
METHOD_NOTES = {
    "bc-ct": "the transformer without returns: it imitates the trajectories",
    "pt-cql": "conservative Q-learning on the same trajectories, with the same observations, but without memory",
    "sac": "learned in the whole maze, without planner and without trajectories",
    "ct": "observes only its surroundings and the vector to the goal; it has no map and no planner",
    "planner": "knows the whole maze; it shows the best result of this low-level controller",
    "explorer": "builds a map from the same local maps, and plans as if unknown space were free",
}
STAGE_LABELS = {
    "prm": "Roadmap", "controller": "Low-level controller", "collect": "Guided trajectories",
    "value": "Value network", "fit": "Control Transformer", "finetune": "Fine-tuning",
    "evaluate": "Evaluation",
}  # fmt: skip
KINDS = {  # kinds of failures: for a single episode, and as the end of a sentence
    "circled": ("went back and forth", "went back and forth over the same few cells until time ran out"),
    "stuck": ("stayed on one spot", "stayed on one spot until time ran out"),
    "late": ("ran out of time on the way", "was still on its way when time ran out"),
    "early": ("ended early", "ended before time ran out, because of a fall or a diverged state"),
}
_SEEN = ("in the maze it was trained in", "in the mazes it was trained in")
_UNSEEN = ("in a maze it had never seen", "in mazes it had never seen")
MINUS, DASH, NARROW = "\N{MINUS SIGN}", "\N{EN DASH}", "\N{NARROW NO-BREAK SPACE}"


def method_label(method: str) -> str:
    """The name of a method for people."""
    return METHOD_LABELS.get(method, method)


def stage_label(stage: str, *, timing: bool = False) -> str:
    """The name of a stage for people. "fit-1" is "fit" in round 1 of fine-tuning.

    Args:
        timing: the name is for the time of the stage; the stage "fit" includes the value network.
    """
    if timing and stage == "fit":
        return "Value and transformer"
    base, again = without_round(stage)
    if base in METHOD_LABELS and base not in STAGE_LABELS:
        return METHOD_LABELS[base]
    return STAGE_LABELS.get(base, base) + (f", fine-tuning {again}" if again else "")


def without_round(stage: str) -> tuple[str, str]:
    """A stage and its round of fine-tuning: "fit-1" is "fit" and "1"; the second is empty if there is none."""
    base, _, again = stage.rpartition("-")
    return (base, again) if base and again.isdecimal() else (stage, "")


def percent(rate: float) -> str:
    """A rate as text, such as 93 %, with a space that does not break."""
    return f"{100 * rate:.0f}{NARROW}%"


def decimal(value: float, digits: int = 2) -> str:
    """A number as text, with a minus sign instead of a hyphen, and with separators of thousands."""
    text = f"{value:,.{digits}f}".replace("-", MINUS)
    return text[1:] if text.startswith(MINUS) and not any(d in text for d in "123456789") else text


def duration(seconds: float) -> str:
    """A time span in its two largest units."""
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def count(n: int, one: str) -> str:
    """A number with its noun, such as "3 goals"."""
    return f"{n:,} {one}" + ("" if n == 1 else "s")


# ------------------------------------------------------------------------------------------------ the verdict


def main_method(run: Run) -> str:
    """The method that the report is about: that of the run, or else the first one."""
    methods = [row["method"] for row in run.rows] or [e.method for e in run.episodes]
    return run.method if run.method in methods or not methods else methods[0]


def headline(run: Run) -> str:
    """The title of a report: its success rate in unseen mazes, or in seen mazes if there are no others."""
    rows = [row for row in run.rows if row["method"] == main_method(run)]
    for seen, where_to in ((False, "never seen before"), (True, "it was trained in")):
        reached, tried = _tally(row for row in rows if bool(row.get("seen")) == seen)
        mazes = len({row["maze"] for row in rows if bool(row.get("seen")) == seen})
        if tried:
            one, many = ("rooms", "rooms") if in_rooms(rows) else ("a maze", "mazes")
            where = f"{one if mazes == 1 else many} {where_to}"
            return f"{percent(reached / tried)} of goals reached in {where}"
    return f"{run.config.get('robot', 'robot')}: no results yet"


def verdict(run: Run) -> str:
    """One sentence with the success rates and the most common kind of failure."""
    method = main_method(run)
    rows = [row for row in run.rows if row["method"] == method]
    parts = []
    unseen = ("in rooms it had never seen",) * 2 if in_rooms(rows) else _UNSEEN
    for seen, one, many in (
        (True, "in the maze it was trained in", "in the mazes it was trained in"),
        (False, *unseen),
    ):
        there = [row for row in rows if bool(row.get("seen")) == seen]
        reached, tried = _tally(there)
        if tried:
            place = one if len({row["maze"] for row in there}) == 1 else many
            parts.append(f"{reached} of {tried}{' goals' if not parts else ''} {place}")
    if not parts:
        return ""
    return f"The {method_label(method)} reached {' and '.join(parts)}; {_failing(run, rows)}."


def in_rooms(rows: Iterable[dict[str, Any]]) -> bool:
    """Whether the results are from rooms, not from mazes."""
    return any("worlds" in row for row in rows)


def size(place: Place, cell_m: float) -> str:
    """The size of a maze or a room; for a room also the number of obstacles and the share of the floor they cover."""
    if isinstance(place, World):
        obstacles = count(len(place.boxes) + len(place.cylinders), "obstacle")
        return f"{place.side_m:g} x {place.side_m:g} m, {obstacles} on {percent(place.covered())} of the floor"
    height, width = (side * cell_m for side in place.shape)
    return f"{width:g} x {height:g} m"


def _tally(rows: Iterable[dict[str, Any]]) -> tuple[int, int]:
    """The number of goals reached, and the number of episodes."""
    pairs = [(number(row.get("success_rate")), number(row.get("episodes"))) for row in rows]
    known = [(rate, int(n)) for rate, n in pairs if rate is not None and n]
    return sum(round(rate * n) for rate, n in known), sum(n for _, n in known)


def _failing(run: Run, rows: list[dict[str, Any]]) -> str:
    """How the main method fails, as the end of a sentence."""
    reached, tried = _tally(rows)
    if reached == tried:
        return "it did not fail once"
    mine = [episodes for episodes in run.episodes if episodes.method == main_method(run)]
    kinds = Counter(failure_kind(run, e, int(i)) for e in mine for i in np.flatnonzero(~e.success))
    failures = kinds.total()
    if not failures:
        return f"{count(tried - reached, 'attempt')} failed; their paths are not available"
    kind, often = kinds.most_common(1)[0]
    if failures == 1:
        return f"the one time it failed, it {KINDS[kind][1]}"
    if often == failures:
        return f"all {failures} times it failed, it {KINDS[kind][1]}"
    mostly = "mostly" if 2 * often > failures else "most often"
    return f"when it failed, it {mostly} ({often} of {failures} times) {KINDS[kind][1]}"


def failure_kind(run: Run, episodes: Episodes, i: int) -> str:
    """How episode ``i`` failed: one of ``KINDS``. The second half of its path decides."""
    if episodes.steps[i] < run.horizon:
        return "early"
    way = track(episodes.path, episodes.steps, episodes.start, i)
    way = way[len(way) // 2 :]
    if np.ptp(way, axis=0).max() < run.cell_m:
        return "stuck"
    cells = np.floor(way / run.cell_m).astype(int)
    entered = 1 + int((np.diff(cells, axis=0) != 0).any(1).sum())
    return "circled" if entered >= 3 * len(np.unique(cells, axis=0)) else "late"


def failure_text(run: Run, episodes: Episodes, i: int) -> str:
    """A short description of a failed episode."""
    kind = KINDS[failure_kind(run, episodes, i)][0]
    after = count(int(episodes.steps[i]), "step")
    return f"{kind}; ended {_missing_m(episodes, i):.1f} m from the goal after {after}"


def _missing_m(episodes: Episodes, i: int) -> float:
    end = track(episodes.path, episodes.steps, episodes.start, i)[-1]
    return float(np.linalg.norm(end - episodes.goal[i]))


def calibration_text(asked: np.ndarray, got: np.ndarray) -> str:
    """A short description of how well the value network predicted the returns."""
    bias = float(np.mean(asked - got))
    spread = float(np.mean(np.abs(asked - got)))
    kept = f"on average, the target was {decimal(abs(bias), 0)} {'higher' if bias > 0 else 'lower'} than the return"
    text = f"{kept}; mean error {decimal(spread, 0)}"
    if len(got) > 2 and np.ptp(asked) > 0 and np.ptp(got) > 0:
        text += f", correlation {decimal(float(np.corrcoef(asked, got)[0, 1]))}"
    return text


def ends(interval: Any) -> tuple[float, float] | None:
    """The lower and upper end of an interval; None if the value is not an interval."""
    if not isinstance(interval, list) or len(interval) != 2:
        return None
    low, high = map(number, interval)
    return None if low is None or high is None else (min(low, high), max(low, high))


def interval(values: Any, show: Callable[[float], str]) -> str:
    """An interval as text; empty if the value is not an interval. The unit appears once."""
    if (found := ends(values)) is None:
        return ""
    first, last = map(show, found)
    if MINUS in first + last:
        return f"{first} to {last}"
    return f"{first.removesuffix(NARROW + '%')}{DASH}{last}"


def stage_facts(done: dict[str, Any]) -> str:
    """The facts of a finished stage, without its time."""
    facts = []
    for name, value in done.items():
        scalar = number(value)
        if name == "wall_s" or scalar is None:
            continue
        rate = "success" in name or name.endswith("_rate")
        whole = scalar == int(scalar)
        text = percent(scalar) if rate else decimal(scalar, 0) if whole else f"{scalar:.3g}".replace("-", MINUS)
        facts.append(f"{text} {name.replace('_', ' ')}")
    return ", ".join(facts[:6])
