"""The Markdown tables of the results pages: from typed rows to lines of text."""

import importlib
import json
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from intervals import INTERVALS, gain_of, of_one_model, pooled
from plots import HELD_OUT_ENOUGH, line_of, minutes, start_of
from rows import CT, LISTS, CqlRow, Origin, Results, Row, TransferRow, Unmade
from study import Variant, load_variants

from ct_jax.evaluate import GUIDED
from ct_jax.settings import from_dict, to_dict

ZOO = Path(__file__).parents[1] / "ct_jax" / "zoo"
LONGER = "long-ct"  # CT with about the same total number of updates as F-CT
# Success rates of the paper's CT [%] (sec. IV-A, table II; sec. IV-B).
PAPER = {
    "point": {"antmaze-large": 84.33, "antmaze-large-eval": 60.33},
    "ant": {"antmaze-large": 90.0, "antmaze-large-eval": 77.33},
    "humanoid": {"antmaze-large": 19.0, "antmaze-large-eval": 18.0, "hall": 26.0},
    "turtlebot3": {"rooms": 92.47},
}
# Lifted variants without and with fine-tuning.
_BOTH = ("cpu-ct", "cpu")
LIFTED = {"point": ("cpu-ct", "roam"), "ant": ("calm+long-ct", "cpu")}


# -------------------------------------------------------------------------------------------------------- Markdown


def grid(names: Sequence[str], body: Iterable[Sequence[str]]) -> list[str]:
    """A Markdown table from the names of its columns and the cells of its lines."""
    head, *lines = (f"| {' | '.join(cells)} |" for cells in (names, *body))
    return [head, "|---" * len(names) + "|", *lines]


def put(text: str, name: str, lines: Sequence[str]) -> str:
    """The text with these lines between the markers called ``name``."""
    marked = re.compile(rf"(<!-- {re.escape(name)} -->\n).*?(<!-- /{re.escape(name)} -->)", re.DOTALL)
    if not marked.search(text):
        print(f"no markers for the table {name}", file=sys.stderr)
    return marked.sub(lambda found: found[1] + "\n".join(lines) + "\n" + found[2], text)


def made_by(
    rows: Sequence[Origin], names: Sequence[str] = (), cells: Callable[[Any], tuple[str, ...]] = lambda row: ()
) -> list[str]:
    """The command, commit, machine and date of rows, without repeated lines.

    Args:
        names: names of additional columns on the left; ``cells`` gives their cells.
    """
    found = dict.fromkeys((*cells(row), *_origin(row)) for row in rows)
    return grid([*names, "command", "commit", "machine", "date"], found)


def _origin(row: Origin) -> tuple[str, ...]:
    return f"`{row.command}`", row.commit, row.hardware, row.created[:10]


def each_model(rows: Sequence[Row]) -> str:
    """Success of each model in percent, by seed; empty for a reference."""
    if rows[0].method in GUIDED:
        return ""
    return ", ".join(f"{round(100 * row.success_rate, 1):g}" for row in sorted(rows, key=lambda row: row.model_seed))


# ---------------------------------------------------------------------------------------------------------- mazes


def method_name(row: Row | Unmade, variants: Mapping[str, Variant]) -> str:
    """The name of a row in tables: the paper's name, the variant's name, or the reference with its settings."""
    if isinstance(row, Row) and row.method in GUIDED:
        margin = f", {row.margin_m:g} m margin" if row.margin_m else ""
        scale = "" if row.action_scale is None else f", action scale {row.action_scale:g}"
        return f"{row.method}{margin}{scale}"
    return label_of(row.variant, variants)


def label_of(name: str, variants: Mapping[str, Variant]) -> str:
    """The name of a variant in tables."""
    variant = variants.get(name)
    if variant and variant.label:
        return variant.label
    return f"F-CT, `{name}`" if variant and variant.tuned_from else f"CT, `{name}`"


def by_method(rows: Iterable[Row], variants: Mapping[str, Variant]) -> dict[tuple[str, str], list[Row]]:
    """The rows of all models, by maze and method: seen mazes first, variants in the order of the robot's file,
    references last."""
    order = list(variants)

    def place(row: Row) -> tuple[Any, ...]:
        at = len(order) if row.method in GUIDED or row.variant not in order else order.index(row.variant)
        return not row.seen, row.maze, at

    together: dict[tuple[str, str], list[Row]] = {}
    for row in sorted(rows, key=place):
        together.setdefault((row.maze, method_name(row, variants)), []).append(row)
    return together


def maze_tables(results: Results, variants: Mapping[str, Variant]) -> list[str]:
    """One table for each maze, with a line for each method."""
    together, falls = by_method(results.rows, variants), any(row.fall_rate for row in results.rows)
    names = ["method", "success %", "each model", "SPL", "return / 100", "collided %"] + ["fell %"] * falls
    lines: list[str] = []
    for maze in dict.fromkeys(maze for maze, _ in together):
        seen = next(rows for (at, _), rows in together.items() if at == maze)[0].seen
        body = []
        for name, models in ((name, rows) for (at, name), rows in together.items() if at == maze):
            cells = [name, pooled(models, "success"), each_model(models), f"{np.mean([row.spl for row in models]):.2f}"]
            cells += [f"{np.mean([row.return_scaled for row in models]):.1f}", pooled(models, "collision")]
            body.append(cells + ([pooled(models, "fall")] if falls else []))
        lines += [f"### {maze} ({'seen' if seen else 'unseen'})", "", *grid(names, body), ""]
    pairs = sorted({(row.episodes, row.seed) for row in results.rows})
    return [*lines, f"{'; '.join(f'{n} pairs of seed {seed}' for n, seed in pairs)} in each maze. {INTERVALS}"]


def differences(results: Results, variants: Mapping[str, Variant]) -> list[str]:
    """F-CT − CT in each maze, as published and lifted, computed for each pair and each model."""
    together, body = by_method(results.rows, variants), []
    names = {label_of(name, variants): variant.tuned_from for name, variant in variants.items() if variant.tuned_from}
    for (maze, name), tuned in together.items():
        before = label_of(names[name] or "", variants) if name in names else ""
        models = of_one_model(together.get((maze, before), []), tuned)
        if models:
            body.append([maze, f"{name} − {before}", gain_of(models), str(len(models))])
    return grid(["maze", "compared", "success, percentage points", "models"], body) if body else []


def reasons(unmade: Sequence[Unmade], variants: Mapping[str, Variant]) -> list[str]:
    """The reasons for missing rows."""
    ordered = sorted(unmade, key=lambda row: (row.variant, row.model_seed))
    body = [[method_name(row, variants), str(row.model_seed), row.why, *_origin(row)] for row in ordered]
    return grid(["missing row", "seed", "reason", "command", "commit", "machine", "date"], body) if body else []


def runs_table(rows: Sequence[Row], variants: Mapping[str, Variant]) -> list[str]:
    """The origin of each variant: seeds, minutes, command, commit, machine and date."""
    order = list(variants)
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in sorted(rows, key=lambda row: order.index(row.variant) if row.variant in order else len(order)):
        who = "planner, explorer" if row.method in GUIDED else f"`{row.variant}`"
        groups.setdefault((who, *_origin(row)), []).append(row)
    body = []
    for (who, *made), found in groups.items():
        seeds = "" if found[0].method in GUIDED else ", ".join(map(str, sorted({row.model_seed for row in found})))
        body.append([who, seeds, _minutes(found), *made])
    return grid(["variant", "seeds", "minutes per model", "command", "commit", "machine", "date"], body)


def _minutes(rows: Sequence[Row]) -> str:
    """Mean minutes for a model, and for collecting its trajectories. Early baselines were not timed."""
    timed = [row for row in rows if row.method == CT or row.learn_wall_s is not None]
    if not timed:
        return ""
    walls = {row.model_seed: row.run_wall_s / 60 for row in timed}
    collected = [row.collect_wall_s / 60 for row in timed if row.collect_wall_s]
    words = f"{np.mean(list(walls.values())):.0f}"
    return f"{words} ({np.mean(collected):.1f} for collection)" if collected else words


# --------------------------------------------------------------------------------------------------------- summary


def summary_table(results: Mapping[str, Results]) -> list[str]:
    """One line for each robot and maze: success of the paper's CT, our CT, and the planner that knows the map.

    Args:
        results: by file name, without suffix.
    """
    names = ["robot", "maze", "CT, paper", "CT as published, small model", "CT as published, the paper's size"]
    names += ["CT, lifted", "F-CT, lifted", "planner with the map"]
    body = []
    for robot, mazes in PAPER.items():
        ct, tuned = LIFTED.get(robot, _BOTH)
        for maze, paper in mazes.items():
            rows, full = (
                [row for row in results.get(f"{robot}-{size}", Results()).rows if row.maze == maze]
                for size in ("cpu", "paper")
            )
            # "ct" is the Turtlebot3's: its model has the paper's size in every preset.
            of = [_models(rows, "published"), _models(full, "published") + _models(rows, "ct")]
            cells = [_together(models) for models in (*of, _models(rows, ct), _models(rows, tuned))]
            planners = sorted((row for row in rows if row.method == "planner"), key=lambda row: row.variant != ct)
            where = f"{maze} ({'seen' if rows and rows[0].seen else 'unseen'})"
            body.append([robot, where, f"{paper:g}", *cells, _together(planners[:1])])
    others = ", ".join(f"{robot}: `{ct}` and `{tuned}`" for robot, (ct, tuned) in LIFTED.items())
    note = "Success rate in % with its 95 % interval; n is the number of trained models. The *lifted* variants are "
    return [*grid(names, body), "", note + f"`{_BOTH[0]}` and `{_BOTH[1]}` ({others})."]


def _models(rows: Iterable[Row], variant: str) -> list[Row]:
    """The rows of a variant's models."""
    return [row for row in rows if (row.variant, row.method) == (variant, CT)]


def _together(rows: Sequence[Row]) -> str:
    """Success [%] over all models with its interval, and the number of models (not for a reference)."""
    if not rows:
        return "not measured"
    return pooled(rows, "success") + ("" if rows[0].method in GUIDED else f", n = {len(rows)}")


# ----------------------------------------------------------------------------------------------------------- rooms


def room_tables(results: Results, heading: str = "##") -> list[str]:
    """One line for each variant and reference; then tables of densities, levels of noise, and the seven pairs."""
    names = ["model", "density", "noise", "success %", "each model", "SPL", "frontal %", "grazing %"]
    lines: list[str] = []
    parts = {"The published rooms": results.rows, "Other densities": results.density, "Noise": results.noise}
    for title, rows in parts.items():
        together: dict[tuple[Any, ...], list[Row]] = {}
        for row in rows:
            together.setdefault((line_of(row), row.density, row.noise), []).append(row)
        body = []
        for (name, density, noise), found in together.items():
            rates = [pooled(found, rate) for rate in ("success", "frontal", "grazing")]
            cells = [name if len(found) == 1 else f"{name}, {len(found)} models", f"{density:g}", f"{noise:g}"]
            spl = f"{sum(row.spl for row in found) / len(found):.2f}"
            body.append([*cells, rates[0], each_model(found), spl, *rates[1:]])
        if rows:
            on = f"{rows[0].worlds} random rooms, {rows[0].pairs} pairs in each, of seed {rows[0].seed}. {INTERVALS}"
            lines += [f"{heading} {title}", "", *grid(names, body), "", on, ""]
    body = [
        [_with_seed(row), f"{row.noise:g}", *(str(count) for count in (row.full, row.partial, row.failed))]
        for row in results.seven
    ]
    if body:
        lines += [f"{heading} The paper's seven pairs, ten times each", ""]
        lines += [*grid(["model", "noise", "full", "partial", "failed"], body), ""]
    return lines[:-1]


def _with_seed(row: Row) -> str:
    return f"{row.variant}, seed {row.model_seed}" if row.method == CT else row.method


# --------------------------------------------------------------------------------------- transfer, PT-CQL, controllers


def transfer_table(rows: Sequence[TransferRow]) -> list[str]:
    """One line for each robot, run and start: success by number of updates, and the updates to 90 % of the final value.

    The final value is the mean success of the better start after the last update. Between two measurements, success is
    interpolated over the logarithm of the updates.
    """
    marks = sorted({row.updates for row in rows})
    names = ["robot", "run", "start", "seeds", *(f"{mark}" for mark in marks), "updates to 90 % of the final success"]
    curves: dict[tuple[str, str, str], dict[int, list[float]]] = {}
    for row in sorted(rows, key=lambda row: row.updates):
        curve = curves.setdefault((row.robot, row.run, start_of(row)), {})
        curve.setdefault(row.updates, []).append(row.success_rate)
    body = []
    for (robot, run, start), curve in curves.items():
        means = {mark: float(np.mean(rates)) for mark, rates in curve.items()}
        finals = [np.mean(other[max(other)]) for of, other in curves.items() if of[:2] == (robot, run)]
        reached = _reached(list(means), list(means.values()), 0.9 * max(finals))
        shown = [f"{100 * means[mark]:.0f}" if mark in means else "" for mark in marks]
        body.append([robot, f"`{run}`", start, str(len(curve[max(curve)])), *shown, reached])
    return grid(names, body)


def _reached(marks: list[int], curve: list[float], enough: float) -> str:
    """The number of updates after which a curve reached ``enough``, interpolated between the marks."""
    at = next((i for i, mean in enumerate(curve) if mean >= enough), None)
    if not at:
        return "later" if at is None else f"at most {marks[0]}"
    before, after = curve[at - 1 : at + 1]
    part = (enough - before) / (after - before)
    return f"{marks[at - 1] * (marks[at] / marks[at - 1]) ** part:.0f}"


def finetuned_table(rows: Sequence[Row], variants_of: Callable[[str], Mapping[str, Variant]]) -> list[str]:
    """One line for each robot, F-CT, CT and maze: success of CT and F-CT, and F-CT − CT, over all seeds.

    CT is the variant before fine-tuning; a second line has CT with as many updates as F-CT, if it was measured.
    """
    names = ["robot", "F-CT", "CT", "maze", "models", "pairs", "CT %", "F-CT %", "F-CT − CT (percentage points)"]
    subject = lambda row: (row.robot, row.variant, row.maze, row.episodes)  # noqa: E731
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in sorted(rows, key=lambda row: row.model_seed):
        found.setdefault(subject(row), []).append(row)
    body = []
    for robot, tuned, maze, pairs in dict.fromkeys(map(subject, rows)):
        variant = variants_of(robot).get(tuned)
        before = variant.tuned_from if variant else None
        for ct in dict.fromkeys((before, LONGER)) if before else ():
            models = of_one_model(found.get((robot, ct, maze, pairs), []), found[robot, tuned, maze, pairs])
            if models:
                rates = [pooled(those, "success") for those in zip(*models, strict=True)]
                what = [robot, f"`{tuned}`", f"`{ct}`", maze, str(len(models)), str(pairs)]
                body.append([*what, *rates, gain_of(models)])
    return grid(names, body)


def cql_table(rows: Sequence[CqlRow]) -> list[str]:
    """One line for each choice of PT-CQL's settings."""
    tried = ("alpha", "target_rate", "reward_scale", "imitation", "updates")
    names = ["robot", *(name.replace("_", " ") for name in tried), "success %"]
    values = lambda row: [f"{getattr(row, name):g}" for name in tried]  # noqa: E731
    return grid(names, ([row.robot, *values(row), pooled([row], "success")] for row in rows))


def controllers_table(controllers: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each shipped low-level controller."""
    names = ["robot", "held-out edges %", "twenty in a row %", "updates", "minutes"]
    names += [f"{HELD_OUT_ENOUGH:.0%} of the edges after", "command", "commit", "machine", "date"]
    body = []
    for found in controllers:
        made, sac = found["made"], found["sac"]
        first = next((f"{at:.0f} min" for at, rate in minutes(found) if rate >= HELD_OUT_ENOUGH), "")
        rates = [f"{100 * made[name]:.1f}" if name in made else "" for name in ("held_out_success", "twenty_in_a_row")]
        wall = f"{made['wall_s'] / 60:.0f}" if "wall_s" in made else ""
        updates = f"{sac['iterations'] * sac['updates']:,}"
        body.append([found["robot"], *rates, updates, wall, first, *_origin(Origin.read(made))])
    return grid(names, body)


# ------------------------------------------------------------------------------------------------------ benchmarks


def benchmark_table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line for each number of a benchmark, and their origin."""
    body = []
    for row in rows:
        ratio, other = row["ratio"], row["other"]
        shown = f"{ratio['median']:.2f} ({ratio['min']:.2f} to {ratio['max']:.2f})" if ratio else ""
        figures = f"{number(row['value'])} ({number(row['min'])} to {number(row['max'])}) {row['unit']}"
        theirs = f"{number(other)} {row['unit']}" if other is not None else ""
        aim = f"{row['asked']:.3g}" if row["asked"] else ""
        body.append([row["name"], figures, row["against"], theirs, shown, aim])
    names = ["what", "median (min to max)", "compared with", "its median", "speed ratio (min to max)", "aim"]
    lines = grid(names, body)
    for words in dict.fromkeys(_made(row["made"]) for row in rows):
        lines += ["", words]
    return lines


def number(value: float) -> str:
    """Four digits, without an exponent."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def _made(made: Mapping[str, Any]) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in made["versions"].items())
    return f"`{made['command']}`; commit {made['commit']}; {made['hardware']}; {made['created'][:10]}; {versions}."


# ----------------------------------------------------------------------------------------------------- model cards


def model_card(robot: str, results: Results) -> dict[str, list[str]]:
    """The generated parts of a shipped model's card, by the names of their markers."""
    shipped: str = importlib.import_module(robot).SHIPPED
    model = json.loads((ZOO / robot / "model.json").read_text("utf-8"))
    settings, seed = to_dict(from_dict(model["settings"])), model["made"]["seed"]
    scale = settings["controller_action_scale"]
    led = (settings["prm"]["margin_m"], None if scale == 1.0 else scale)

    def beside(row: Row) -> bool:
        """Whether a row belongs to the shipped model, or to a reference with the same margin and action scale."""
        if row.method in GUIDED:
            return robot == "turtlebot3" or (row.margin_m, row.action_scale) == led
        return (row.variant, row.model_seed, row.method) == (shipped, seed, CT)

    found = Results(*([row for row in getattr(results, name) if beside(row)] for name in LISTS))
    tables = room_tables(found, "###") if robot == "turtlebot3" else maze_tables(found, load_variants(robot))
    measured = [row for name in LISTS for row in getattr(found, name) if row.method == CT]
    made = [f"Commands of the rows of `{shipped}`:", "", *made_by(measured)]
    return {"facts": _facts(model, robot, shipped), "metrics": [*tables, "", *made]}


def _facts(model: Mapping[str, Any], robot: str, shipped: str) -> list[str]:
    settings, made = to_dict(from_dict(model["settings"])), Origin.read(model["made"])
    net, collect, recover = settings["model"], settings["collect"], settings["recover"]
    rounds, last = settings["rounds"], settings["last_fit"] or settings["round_fit"]
    fit, mazes = settings["fit"], settings["random_mazes"]
    where = f"in `antmaze-large` and {mazes} random mazes" if mazes else "in `antmaze-large`"
    where = "in random rooms" if robot == "turtlebot3" else where
    data = f"{collect['trajectories']} trajectories {where}, guided by the {collect['guide']}; "
    data += f"action noise {collect['noise']:g}"
    training = f"{fit['updates']} updates with {fit['batch']} windows of {fit['steps']} steps"
    if rounds:
        training += f"; {rounds} rounds of fine-tuning with {recover['recoveries']} recoveries each, "
        training += f"{last['updates']} updates in the last round"
    weights = ZOO / robot / "weights.safetensors"
    body = [
        ["variant", f"`{shipped}` of `experiments/{robot}.py`, seed {model['made']['seed']}"],
        ["data", data],
        ["training", training],
        ["architecture", f"{net['layers']} layers, {net['heads']} heads, width {net['width']}, K = {net['context']}"],
        ["weights", f"{weights.stat().st_size / 1e6:.1f} MB, {parameters(weights):,} parameters in all networks"],
        ["command", f"`{made.command}`"],
        ["commit, machine, date", f"{made.commit}; {made.hardware}; {made.created[:10]}"],
        ["versions", ", ".join(f"{name} {version}" for name, version in model["made"]["versions"].items())],
    ]
    return grid(["what", "value"], body)


def parameters(weights: Path) -> int:
    """The number of parameters in a safetensors file, from its header."""
    with weights.open("rb") as file:
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    return sum(int(np.prod(entry["shape"])) for name, entry in header.items() if name != "__metadata__")
