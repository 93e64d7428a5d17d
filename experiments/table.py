"""Write the tables of ``experiments/results`` and ``benchmarks/results`` into README.md, between their markers.

    python experiments/table.py

No number of the README is typed by hand. A table stands between ``<!-- NAME -->`` and ``<!-- /NAME -->``, NAME being
the results file without ``.json``.
"""

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
from _variants import LONGER, TUNED, untuned

from ct_jax.evaluate import GUIDED, wilson_of

ROOT = Path(__file__).parents[1]
# Names of F-CT, and of what each was before fine-tuning.
FINE_TUNED = {"F-CT": "CT"} | {f"F-CT, `{name}`": f"CT, `{untuned(name)}`" for name in TUNED}
_BASELINES = {"pt-cql": "PT-CQL", "sac": "SAC alone"}
_ORDER = ["CT", "BC-CT", "F-CT", *_BASELINES.values()]
_ORDER += dict.fromkeys(name for tuned, ct in list(FINE_TUNED.items())[1:] for name in (ct, tuned))
# Success of the paper's CT [%], sec. IV; and what lifts ours, without and with fine-tuning.
_PAPER = {
    "point": {"antmaze-large": 84.33, "antmaze-large-eval": 60.33},
    "ant": {"antmaze-large": 90.0, "antmaze-large-eval": 77.33},
    "humanoid": {"antmaze-large": 19.0, "antmaze-large-eval": 18.0, "hall": 26.0},
    "turtlebot3": {"rooms": 92.47},
}
_BOTH = ("cpu-ct", "cpu")
_LIFTED = {"point": ("cpu-ct", "roam"), "ant": ("calm+long-ct", "cpu")}
_INTERVALS = "95 % intervals, of several models over models and pairs"


def summary_table(results: dict[str, dict[str, Any]]) -> list[str]:
    """One line for each robot and maze: the paper's CT, ours, and the planner that knows the map; success alone.

    Args:
        results: by the files' names.
    """
    names = [
        "robot",
        "maze",
        "CT, paper",
        "CT as published, small",
        "CT as published, the paper's size",
        "CT, lifted",
        "F-CT, lifted",
        "planner with the map",
    ]
    body = []
    for robot, mazes in _PAPER.items():
        ct, tuned = _LIFTED.get(robot, _BOTH)
        for maze, paper in mazes.items():
            rows, full = (
                [row for row in results.get(f"{robot}-{size}", {}).get("rows", []) if row["maze"] == maze]
                for size in ("cpu", "paper")
            )
            # "ct" is the Turtlebot3's, whose model is no larger in the paper.
            of = [_models(rows, "published"), _models(full, "published") + _models(rows, "ct")]
            cells = [_together(models) for models in (*of, _models(rows, ct), _models(rows, tuned))]
            planners = sorted((r for r in rows if r["method"] == "planner"), key=lambda r: r["variant"] != ct)
            where = f"{maze} ({'seen' if rows and rows[0]['seen'] else 'unseen'})"
            body.append([robot, where, f"{paper:g}", *cells, _together(planners[:1])])
    others = ", ".join(f"of the {robot} `{ct}` and `{tuned}`" for robot, (ct, tuned) in _LIFTED.items())
    note = f"Success in % with its 95 % interval, of n trained models. Lifted are `{'` and `'.join(_BOTH)}`, {others}."
    return [*grid(names, body), "", note]


def grid(names: list[str], body: list[list[str]]) -> list[str]:
    """A table in Markdown, from the names of its columns and the cells of its lines."""
    head, *lines = (f"| {' | '.join(cells)} |" for cells in (names, *body))
    return [head, "|---" * len(names) + "|", *lines]


def _models(rows: list[dict[str, Any]], variant: str) -> list[dict[str, Any]]:
    """The rows of a variant's models."""
    return [row for row in rows if (row["variant"], row["method"]) == (variant, "ct")]


def _together(rows: list[dict[str, Any]]) -> str:
    """The success of models together with its interval [%], and how many they are; of a reference alone."""
    if not rows:
        return "not measured"
    return pooled(rows, "success") + ("" if rows[0]["method"] in GUIDED else f", n = {len(rows)}")


def experiment_table(results: dict[str, Any]) -> list[str]:
    """One line for each maze and method, its models together, and what fine-tuning adds, with 95 % intervals."""
    rows = results["rows"]
    falls = any(row.get("fall_rate") for row in rows)
    names = ["maze", "method", "success %", "each model", "SPL", "return / 100", "collided %"] + ["fell %"] * falls
    body = []
    together: dict[tuple[bool, str, str], list[dict[str, Any]]] = {}
    for row in sorted(rows, key=lambda row: (not row["seen"], row["maze"], _place(row))):
        together.setdefault((row["seen"], row["maze"], method_name(row)), []).append(row)
    for (seen, maze, name), models in together.items():
        cells = [f"{maze} ({'seen' if seen else 'unseen'})", name, pooled(models, "success"), each_model(models)]
        cells += [f"{np.mean([row['spl'] for row in models]):.2f}"]
        cells += [f"{np.mean([row['return_scaled'] for row in models]):.1f}", pooled(models, "collision")]
        cells += [pooled(models, "fall")] if falls else []
        body.append(cells)
    pairs = {(row["episodes"], row["seed"]) for row in rows}
    on = "; ".join(f"{n} pairs of seed {seed}" for n, seed in sorted(pairs))
    seeds = ", ".join(str(seed) for seed in sorted({row["model_seed"] for row in rows}))
    note = f"{commands(rows)}; {on} in each maze; models of seeds {seeds}; {_INTERVALS}; {origin(rows)}"
    besides = differences(together) + reasons(results.get("unmade", []))
    return [*grid(names, body), *besides, *folded(f"{note}; {took(rows)}.")]


def folded(note: str) -> list[str]:
    """What made a table, which is longer than it, behind a line to be opened."""
    return ["", "<details><summary>made by: commands, commits, machines, times</summary>", "", note, "", "</details>"]


def reasons(unmade: list[dict[str, Any]]) -> list[str]:
    """Why methods have no row."""
    told = [
        f"{method_name(row)}, seed {row['model_seed']}: {row['why']} ({commands([row])}; {origin([row])})"
        for row in sorted(unmade, key=lambda row: (row["variant"], row["model_seed"]))
    ]
    return ["", f"Without a row: {'; '.join(told)}."] if told else []


def each_model(rows: list[dict[str, Any]]) -> str:
    """Success of each model in percent, by seed; of a reference, nothing."""
    if rows[0]["method"] in GUIDED:
        return ""
    return ", ".join(
        f"{round(100 * row['success_rate'], 1):g}" for row in sorted(rows, key=lambda row: row["model_seed"])
    )


def took(rows: list[dict[str, Any]]) -> str:
    """How long a model takes on each machine, in the mean of its seeds, and its trajectories."""
    walls: dict[str, dict[str, dict[int, float]]] = {}
    timed = lambda row: row["method"] not in _BASELINES or "learn_wall_s" in row  # noqa: E731  # early rows have none
    for row in filter(timed, rows):
        seeds = walls.setdefault(row["hardware"], {}).setdefault(row["variant"], {})
        seeds[row["model_seed"]] = row["run_wall_s"] / 60
    each = {
        machine: ", ".join(f"{name} {np.mean(list(seeds.values())):.0f} min" for name, seeds in variants.items())
        for machine, variants in walls.items()
    }
    words = "; ".join(f"a model takes on {machine}: {times}" for machine, times in each.items())
    collecting = [row["collect_wall_s"] / 60 for row in rows if row.get("collect_wall_s")]
    if collecting:
        words += f" (of them, for the planning trajectories: {min(collecting):.1f} to {max(collecting):.1f})"
    return words


def method_name(row: dict[str, Any]) -> str:
    """What the paper calls a row's method; of other variants, the name; of references, also their margin."""
    method, variant = str(row["method"]), str(row["variant"])
    if method in GUIDED:
        kept = f", {row['margin_m']:g} m off walls" if row.get("margin_m") else ""
        return f"{method}{kept}, {row['effort']:.0%} of the effort" if "effort" in row else f"{method}{kept}"
    if method != "ct":
        return _BASELINES.get(method, method)
    named = {"published": "CT", "bc": "BC-CT", "f-ct": "F-CT"} | {name: f"F-CT, `{name}`" for name in TUNED}
    return named.get(variant, f"CT, `{variant}`")


def _place(row: dict[str, Any]) -> int:
    """Where a row stands in its maze: as the paper has them, then what lifts them, then the references."""
    name = method_name(row)
    return _ORDER.index(name) if name in _ORDER else len(_ORDER)


def differences(together: dict[tuple[bool, str, str], list[dict[str, Any]]]) -> list[str]:
    """F-CT less CT in each maze, as published and lifted, pair by pair and model by model."""
    body = []
    for (seen, maze, name), tuned in together.items():
        before = FINE_TUNED.get(name, "")
        models = of_one_model(together.get((seen, maze, before), []), tuned)
        if models:
            body.append([maze, f"{name} less {before}", gain_of(models), str(len(models))])
    return ["", *grid(["maze", "success, pair by pair", "of 100", "models"], body)] if body else []


def of_one_model(before: list[dict[str, Any]], after: list[dict[str, Any]]) -> list[tuple[dict[str, Any], ...]]:
    """The rows of F-CT that have one of CT, each after it: of one seed, led by one controller."""

    def model(row: dict[str, Any]) -> tuple[Any, ...]:
        return row["model_seed"], row.get("controller")

    first = {model(row): row for row in before}
    return [(first[model(row)], row) for row in after if model(row) in first]


def gain_of(models: list[tuple[dict[str, Any], ...]]) -> str:
    """What fine-tuning adds to the success of several models, pair by pair, in percent with its interval."""
    changes = [flags(after, "success") - flags(before, "success") for before, after in models]
    low, high = interval_of_mean(np.stack(changes))
    return f"{100 * np.mean(changes):+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"


def flags(row: dict[str, Any], name: str) -> np.ndarray:
    """What a row's rate of that name counts, 0 or 1, of each episode [n]."""
    return np.array([int(digit) for digit in row["outcomes"][name]])


def interval_of_mean(values: np.ndarray) -> tuple[float, float]:
    """95 % interval of the mean of values [models, pairs]: a bootstrap that draws both models and pairs."""
    rng = np.random.default_rng(0)
    models, pairs = (rng.integers(n, size=(10_000, n)) for n in values.shape)
    means = [values[np.ix_(m, p)].mean() for m, p in zip(models, pairs, strict=True)]
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def room_table(results: dict[str, Any]) -> list[str]:
    """One line for each variant and reference, its models together; then densities, levels of noise, seven pairs."""
    names = ["model", "density", "noise", "success %", "each model", "SPL", "frontal %", "grazing %"]
    body = []
    together: dict[tuple[str, float, float], list[dict[str, Any]]] = {}
    sweeps = [*results.get("density", []), *results.get("noise", [])]
    for row in results["rows"] + sweeps:
        together.setdefault((line_of(row), row["density"], row["noise"]), []).append(row)
    for (name, density, noise), rows in together.items():
        spl = sum(row["spl"] for row in rows) / len(rows)
        name = name if len(rows) == 1 else f"{name}, {len(rows)} models"
        success, *touched = (pooled(rows, rate) for rate in ("success", "frontal", "grazing"))
        cells = [name, f"{density:g}", f"{noise:g}", success, each_model(rows), f"{spl:.2f}", *touched]
        body.append(cells)
    seven = []
    for row in results.get("seven", []):
        name = f"{row['variant']}, seed {row['model_seed']}" if row["method"] == "ct" else row["method"]
        counts = [str(row[grade]) for grade in ("full", "partial", "failed")]
        seven.append([name, f"{row['noise']:g}", *counts])
    rows = results["rows"]
    on = f"{rows[0]['worlds']} random rooms, {rows[0]['pairs']} pairs in each, of seed {rows[0]['seed']}"
    on += f" ({sweeps[0]['pairs']} where density or noise is another)" if sweeps else ""
    note = f"{commands(rows + sweeps)}; {on}; {_INTERVALS}; {origin(rows + sweeps)}; {took(rows)}."
    graded = grid(["model", "noise", "seven pairs: full", "partial", "failed"], seven)
    return [*grid(names, body), "", *graded, *folded(note)]


def line_of(row: dict[str, Any]) -> str:
    """The model or reference to which a row of the rooms belongs."""
    return row["variant"] if row["method"] == "ct" else row["method"]


def transfer_table(results: dict[str, Any]) -> list[str]:
    """One line for each robot, run and start: success after so many updates, and when 90 % of the final one was there.

    The final success is the better of both starts' means after the last update. Between two of the numbers of updates
    success is taken to grow with their logarithm.
    """
    rows = results["rows"]
    marks = sorted({row["updates"] for row in rows})
    names = ["robot", "run", "start", "seeds", *(f"{mark}" for mark in marks), "90 % of the final at"]
    body = []
    curves: dict[tuple[str, str, str], dict[int, list[float]]] = {}
    for row in sorted(rows, key=lambda row: row["updates"]):
        curve = curves.setdefault((row["robot"], row["run"], start_of(row)), {})
        curve.setdefault(row["updates"], []).append(row["success_rate"])
    for (robot, run, start), curve in curves.items():
        means = {mark: float(np.mean(rates)) for mark, rates in curve.items()}
        finals = [np.mean(other[max(other)]) for of, other in curves.items() if of[:2] == (robot, run)]
        reached = _reached(list(means), list(means.values()), 0.9 * max(finals))
        shown = [f"{100 * means[mark]:.0f}" if mark in means else "" for mark in marks]
        cells = [robot, f"`{run}`", start, str(len(curve[max(curve)])), *shown, reached]
        body.append(cells)
    on = f"success in % after so many updates, {rows[0]['episodes']} pairs in the unseen maze, mean of the seeds"
    return [*grid(names, body), "", f"{commands(rows)}; {on}; {origin(rows)}."]


def start_of(row: dict[str, Any]) -> str:
    """What a curve of the transfer began with, in words."""
    return "from scratch" if row["source"] is None else f"from the trunk of the {row['start']}'s {row['source']}"


def _reached(marks: list[int], curve: list[float], enough: float) -> str:
    """After how many updates a curve had so much, interpolated between the marks."""
    at = next((i for i, mean in enumerate(curve) if mean >= enough), None)
    if not at:
        return "later" if at is None else f"at most {marks[0]}"
    before, after = curve[at - 1 : at + 1]
    share = (enough - before) / (after - before)
    return f"{marks[at - 1] * (marks[at] / marks[at - 1]) ** share:.0f}"


def commands(rows: list[dict[str, Any]]) -> str:
    """The commands that made the rows."""
    return ", ".join(f"`{command}`" for command in dict.fromkeys(row["command"] for row in rows))


def origin(rows: list[dict[str, Any]]) -> str:
    """Commits, machines and days of the rows."""
    facts = (("commit", None), ("hardware", None), ("created", 10))
    found = [", ".join(sorted({row[key][:length] for row in rows})) for key, length in facts]
    return f"commit {found[0]}; {found[1]}; {found[2]}"


def pooled(rows: list[dict[str, Any]], name: str) -> str:
    """A rate of all models together, in percent with its interval."""
    rate, low, high = rate_of(rows, name)
    return f"{rate:.1f} ({low:.0f} to {high:.0f})"


def rate_of(rows: list[dict[str, Any]], name: str) -> tuple[float, float, float]:
    """A rate of all models together and the ends of its interval [%].

    Models differ, and meet the same pairs: several are as uncertain as a bootstrap over both says, if that is more.
    """
    n = sum(row["episodes"] for row in rows)
    low, high = wilson_of(sum(round(row[f"{name}_rate"] * row["episodes"]) for row in rows), n)
    rate = sum(row[f"{name}_rate"] * row["episodes"] for row in rows) / n
    if len(rows) > 1 and all(name in row.get("outcomes", ()) for row in rows):
        ends = interval_of_mean(np.stack([flags(row, name) for row in rows]))
        low, high = min(low, ends[0]), max(high, ends[1])
    return 100 * rate, 100 * low, 100 * high


def benchmark_table(rows: list[dict[str, Any]]) -> list[str]:
    """One line a figure of which something is asked, if there are such; all are in the benchmark's docstring."""
    body = []
    for row in [row for row in rows if row.get("asked")] or rows:
        ratio = row["ratio"]
        shown = f"{ratio['median']:.2f} ({ratio['min']:.2f}-{ratio['max']:.2f})" if ratio else ""
        figures = f"{row['value']:,.4g} ({row['min']:,.4g}-{row['max']:,.4g}) {row['unit']}"
        asked = f"{row['asked']:.3g}" if row.get("asked") else ""
        body.append([row["name"], figures, row["against"], shown, asked])
    made = rows[0]["made"]
    name = f"`{made['command']}`; commit {made['commit']}; {made['hardware']}; {made['created'][:10]}."
    return [*grid(["what", "median (min-max)", "against", "times (min-max)", "asked"], body), "", name]


def finetuned_table(results: dict[str, Any]) -> list[str]:
    """One line for each robot, F-CT, CT and maze: CT, F-CT and what lies between them, of the models of all seeds.

    The CT is the one before it and, where there is one of the same data, that which has learned for as long.
    """
    names = ["robot", "F-CT", "CT", "maze", "models", "pairs", "CT %", "F-CT %", "F-CT less CT, of 100"]
    body = []
    rows = results["rows"]
    subject = lambda row: (row["robot"], row["variant"], row["maze"], row["episodes"])  # noqa: E731
    found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in sorted(rows, key=lambda row: row["model_seed"]):
        found.setdefault(subject(row), []).append(row)
    for robot, tuned, maze, pairs in dict.fromkeys(subject(row) for row in rows if row["variant"] in TUNED):
        for ct in dict.fromkeys((untuned(tuned), LONGER)):
            models = of_one_model(found.get((robot, ct, maze, pairs), []), found[robot, tuned, maze, pairs])
            if models:
                rates = [pooled(list(those), "success") for those in zip(*models, strict=True)]
                counts = [str(len(models)), str(pairs)]
                body.append([robot, f"`{tuned}`", f"`{ct}`", maze, *counts, *rates, gain_of(models)])
    trained = ", ".join(sorted({f"{row['trained']['hardware']}, commit {row['trained']['commit']}" for row in rows}))
    on = f"pairs of seed {rows[0]['seed']}"
    note = f"{commands(rows)}; {on}; {_INTERVALS}; {origin(rows)}; models made on {trained}."
    return [*grid(names, body), *folded(note)]


def cql_table(results: dict[str, Any]) -> list[str]:
    """One line for each settings of PT-CQL that were tried."""
    names = ["robot", "alpha", "target rate", "reward scale", "imitation", "updates", "success %"]
    body = []
    rows = results["rows"]
    tried = ("alpha", "target_rate", "reward_scale", "imitation", "updates")
    for row in rows:
        cells = [row["robot"], *(f"{row[name]:g}" for name in tried), pooled([row], "success")]
        body.append(cells)
    on = f"{rows[0]['episodes']} pairs of seed {rows[0]['seed']} in {rows[0]['maze']}"
    return [*grid(names, body), "", f"{commands(rows)}; {on}; {origin(rows)}."]


TABLES = {"finetuned": finetuned_table, "cql": cql_table, "transfer": transfer_table}  # by the file's name


def _table(name: str, data: Any) -> list[str]:
    if name in TABLES:
        return TABLES[name](data)
    if not isinstance(data, dict):
        return benchmark_table(data)
    return room_table(data) if "worlds" in data["rows"][0] else experiment_table(data)


def put(text: str, name: str, lines: list[str]) -> str:
    """The text with these lines between its markers of that name."""
    marked = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    if not marked.search(text):
        print(f"README.md has no place for {name}", file=sys.stderr)
    return marked.sub(lambda m: m[1] + "\n".join(lines) + "\n" + m[2], text)


def with_tables(text: str) -> str:
    """The text of README.md with the tables of all results."""
    files = sorted([*ROOT.glob("experiments/results/*.json"), *ROOT.glob("benchmarks/results/*.json")])
    found = {file.stem: json.loads(file.read_text("utf-8")) for file in files}
    text = put(text, "summary", summary_table(found))
    for name, data in found.items():
        text = put(text, name, _table(name, data))
    return text


def main() -> int:
    """Rewrite README.md."""
    readme = ROOT / "README.md"
    readme.write_text(with_tables(readme.read_text("utf-8")), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
