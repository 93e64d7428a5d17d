"""What the numbers of a run mean, in words: labels, the headline, the verdict, and how an episode failed."""

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ct_envs.turtlebot3_world import World
from ct_jax.report.pictures import track
from ct_jax.report.reading import Episodes, Place, Run, number

METHOD_LABELS = {"ct": "Control Transformer", "planner": "Planner with the full map", "explorer": "Explorer"}
METHOD_NOTES = {
    "ct": "senses only its surroundings and the direction of the goal; no map, no planner",
    "planner": "knows the whole maze, so it shows what the low-level controller can do at best",
    "explorer": "remembers what the same local maps showed, and plans through the unknown as if it were free",
}
STAGE_LABELS = {
    "prm": "Roadmap", "controller": "Low-level controller", "collect": "Guided trajectories",
    "value": "Value network", "fit": "Control Transformer", "finetune": "Fine-tuning",
    "evaluate": "Evaluation",
}  # fmt: skip
KINDS = {  # how a failed episode went, for a single one and as the end of a sentence
    "circled": ("went back and forth", "went back and forth over the same few cells until time ran out"),
    "stuck": ("stayed on one spot", "stayed on one spot until time ran out"),
    "late": ("ran out of time on the way", "was still on its way when time ran out"),
    "early": ("broke off early", "broke off before time was up, by a fall or a fault"),
}
_SEEN = ("in the maze it was trained in", "in the mazes it was trained in")
_UNSEEN = ("in a maze it had never seen", "in mazes it had never seen")
MINUS, DASH, NARROW = "\N{MINUS SIGN}", "\N{EN DASH}", "\N{NARROW NO-BREAK SPACE}"


def method_label(method: str) -> str:
    """The name of a method for people."""
    return METHOD_LABELS.get(method, method)


def stage_label(stage: str, *, timing: bool = False) -> str:
    """The name of a stage for people; "fit-1" is "fit" in round 1 of the fine-tuning. ``timing``: of all it does."""
    if timing and stage == "fit":
        return "Value and transformer"
    base, _, again = stage.partition("-")
    return STAGE_LABELS.get(base, base) + (f", fine-tuning {again}" if again else "")


def percent(rate: float) -> str:
    """93 %, never broken over two lines."""
    return f"{100 * rate:.0f}{NARROW}%"


def decimal(value: float, digits: int = 2) -> str:
    """A number with a real minus sign and thousands apart."""
    text = f"{value:,.{digits}f}".replace("-", MINUS)
    return text[1:] if text.startswith(MINUS) and not any(d in text for d in "123456789") else text


def duration(seconds: float) -> str:
    """A time span in its two largest units."""
    if seconds < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def count(n: int, one: str) -> str:
    """3 goals."""
    return f"{n:,} {one}" + ("" if n == 1 else "s")


# ------------------------------------------------------------------------------------------------ the verdict


def main_method(run: Run) -> str:
    """The method a report is about: the transformer, or the first one there is."""
    methods = [row["method"] for row in run.rows] or [e.method for e in run.episodes]
    return "ct" if "ct" in methods or not methods else methods[0]


def headline(run: Run) -> str:
    """The title of a report: its most telling number."""
    rows = [row for row in run.rows if row["method"] == main_method(run)]
    for seen, where_to in ((False, "never seen before"), (True, "it was trained in")):
        reached, tried = _tally(row for row in rows if bool(row.get("seen")) == seen)
        mazes = len({row["maze"] for row in rows if bool(row.get("seen")) == seen})
        if tried:
            one, many = ("rooms", "rooms") if in_rooms(rows) else ("a maze", "mazes")
            where = f"{one if mazes == 1 else many} {where_to}"
            return f"{percent(reached / tried)} of goals reached in {where}"
    return f"A {run.config.get('robot', 'robot')} on its way: no results yet"


def verdict(run: Run) -> str:
    """One sentence: what the success rates mean, and how the robot fails if it does."""
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
    """Whether results are of rooms, not of mazes."""
    return any("worlds" in row for row in rows)


def size(place: Place, cell_m: float) -> str:
    """How large a maze or a room is, and how much stands in it."""
    if isinstance(place, World):
        obstacles = count(len(place.boxes) + len(place.cylinders), "obstacle")
        return f"{place.side_m:g} x {place.side_m:g} m, {obstacles} on {percent(place.covered())} of the floor"
    height, width = (side * cell_m for side in place.shape)
    return f"{width:g} x {height:g} m"


def _tally(rows: Iterable[dict[str, Any]]) -> tuple[int, int]:
    """Goals reached, and goals tried for."""
    pairs = [(number(row.get("success_rate")), number(row.get("episodes"))) for row in rows]
    known = [(rate, int(n)) for rate, n in pairs if rate is not None and n]
    return sum(round(rate * n) for rate, n in known), sum(n for _, n in known)


def _failing(run: Run, rows: list[dict[str, Any]]) -> str:
    """How the main method fails."""
    reached, tried = _tally(rows)
    if reached == tried:
        return "it did not fail once"
    mine = [episodes for episodes in run.episodes if episodes.method == main_method(run)]
    kinds = Counter(failure_kind(run, e, int(i)) for e in mine for i in np.flatnonzero(~e.success))
    failures = kinds.total()
    if not failures:
        return f"{count(tried - reached, 'attempt')} failed, and no paths were kept that would show how"
    kind, often = kinds.most_common(1)[0]
    if failures == 1:
        return f"the one time it failed, it {KINDS[kind][1]}"
    if often == failures:
        return f"all {failures} times it failed, it {KINDS[kind][1]}"
    mostly = "mostly" if 2 * often > failures else "most often"
    return f"when it failed, it {mostly} ({often} of {failures} times) {KINDS[kind][1]}"


def failure_kind(run: Run, episodes: Episodes, i: int) -> str:
    """How episode ``i`` failed, one of ``KINDS``, judged by the second half of its way."""
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
    """What happened in a failed episode, in half a sentence."""
    kind = KINDS[failure_kind(run, episodes, i)][0]
    after = count(int(episodes.steps[i]), "step")
    return f"{kind}; ended {_missing_m(episodes, i):.1f} m from the goal after {after}"


def _missing_m(episodes: Episodes, i: int) -> float:
    end = track(episodes.path, episodes.steps, episodes.start, i)[-1]
    return float(np.linalg.norm(end - episodes.goal[i]))


def calibration_text(asked: np.ndarray, got: np.ndarray) -> str:
    """How well the value network predicted the returns."""
    bias = float(np.mean(asked - got))
    spread = float(np.mean(np.abs(asked - got)))
    kept = f"asked for {decimal(abs(bias), 0)} {'more' if bias > 0 else 'less'} than it got on average"
    text = f"{kept}; typical error {decimal(spread, 0)}"
    if len(got) > 2 and np.ptp(asked) > 0 and np.ptp(got) > 0:
        text += f", correlation {decimal(float(np.corrcoef(asked, got)[0, 1]))}"
    return text


def ends(interval: Any) -> tuple[float, float] | None:
    """The lower and upper end of an interval, or nothing if it is none."""
    if not isinstance(interval, list) or len(interval) != 2:
        return None
    low, high = map(number, interval)
    return None if low is None or high is None else (min(low, high), max(low, high))


def interval(values: Any, show: Callable[[float], str]) -> str:
    """An interval as text, or nothing. The unit is said once, and a minus sign never follows a dash."""
    if (found := ends(values)) is None:
        return ""
    first, last = map(show, found)
    if MINUS in first + last:
        return f"{first} to {last}"
    return f"{first.removesuffix(NARROW + '%')}{DASH}{last}"


def stage_facts(done: dict[str, Any]) -> str:
    """What a finished stage says of itself, its time aside."""
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
