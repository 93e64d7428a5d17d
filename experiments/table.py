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

from ct_jax.evaluate import wilson_of

ROOT = Path(__file__).parents[1]


def percent(row: dict[str, Any], name: str) -> str:
    """A rate in percent with its interval."""
    low, high = row[f"{name}_ci95"]
    return f"{100 * row[f'{name}_rate']:.0f} ({100 * low:.0f} to {100 * high:.0f})"


def mean(value: float, interval: list[float], digits: int) -> str:
    """A mean with its interval."""
    return f"{value:.{digits}f} ({interval[0]:.{digits}f} to {interval[1]:.{digits}f})"


def experiment_table(results: dict[str, Any]) -> list[str]:
    """One line for each maze, model and method, with 95 % intervals."""
    rows = results["rows"]
    falls = any(row.get("fall_rate") for row in rows)
    names = ["maze", "model", "method", "success %", "SPL", "return / 100", "collided %"] + ["fell %"] * falls
    lines = ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
    for row in sorted(rows, key=lambda row: not row["seen"]):
        maze = f"{row['maze']} ({'seen' if row['seen'] else 'unseen'})"
        cells = [maze, f"{row['variant']}, seed {row['model_seed']}", row["method"], percent(row, "success")]
        cells += [mean(row["spl"], row["spl_ci95"], 2)]
        cells += [mean(row["return_scaled"], row["return_scaled_ci95"], 1), percent(row, "collision")]
        cells += [percent(row, "fall")] if falls else []
        lines.append("| " + " | ".join(cells) + " |")
    made = {(row["commit"], row["hardware"], row["created"][:10]) for row in rows}
    commits, machines, days = (", ".join(sorted({m[i] for m in made})) for i in range(3))
    pairs = {(row["episodes"], row["seed"]) for row in rows}
    on = "; ".join(f"{n} pairs of seed {seed}" for n, seed in sorted(pairs))
    walls = ", ".join(
        f"{variant} {minutes:.0f} min"
        for variant, minutes in dict.fromkeys((row["variant"], row["run_wall_s"] / 60) for row in rows)
    )
    note = f"`{results['command']}`; {on} in each maze, 95 % intervals; commit {commits}; {machines}; {days}; {walls}."
    return [*lines, "", note]


def room_table(results: dict[str, Any]) -> list[str]:
    """One line for each variant and reference, its models together; then densities, levels of noise, seven pairs."""
    names = ["model", "density", "noise", "success %", "SPL", "frontal %", "grazing %"]
    lines = ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
    together: dict[tuple[str, float, float], list[dict[str, Any]]] = {}
    for row in results["rows"] + results["density"] + results["noise"]:
        name = row["variant"] if row["method"] == "ct" else row["method"]
        rows = together.setdefault((name, row["density"], row["noise"]), [])
        if row["model_seed"] not in [other["model_seed"] for other in rows]:  # the plain rooms are in every sweep
            rows.append(row)
    for (name, density, noise), rows in together.items():
        spl = sum(row["spl"] for row in rows) / len(rows)
        name = name if len(rows) == 1 else f"{name}, {len(rows)} models"
        rates = [pooled(rows, rate) for rate in ("success", "frontal", "grazing")]
        lines.append("| " + " | ".join([name, f"{density:g}", f"{noise:g}", rates[0], f"{spl:.2f}", *rates[1:]]) + " |")
    lines += ["", "| model | noise | seven pairs: full | partial | failed |", "|---|---|---|---|---|"]
    for row in results["seven"]:
        name = f"{row['variant']}, seed {row['model_seed']}" if row["method"] == "ct" else row["method"]
        counts = [str(row[grade]) for grade in ("full", "partial", "failed")]
        lines.append("| " + " | ".join([name, f"{row['noise']:g}", *counts]) + " |")
    rows = results["rows"]
    made = [", ".join(sorted({str(row[key])[:length] for row in rows}))
            for key, length in (("commit", None), ("hardware", None), ("created", 10))]  # fmt: skip
    on = f"{rows[0]['worlds']} random rooms, {rows[0]['pairs']} pairs in each, of seed {rows[0]['seed']}"
    note = f"`{results['command']}`; {on}; 95 % intervals; commit {made[0]}; {made[1]}; {made[2]}."
    return [*lines, "", note]


def pooled(rows: list[dict[str, Any]], name: str) -> str:
    """A rate of all models together, in percent with its interval."""
    n = sum(row["episodes"] for row in rows)
    low, high = wilson_of(sum(round(row[f"{name}_rate"] * row["episodes"]) for row in rows), n)
    rate = sum(row[f"{name}_rate"] * row["episodes"] for row in rows) / n
    return f"{100 * rate:.1f} ({100 * low:.0f} to {100 * high:.0f})"


def benchmark_table(rows: list[dict[str, Any]]) -> list[str]:
    """One line a figure."""
    lines = ["| what | median (min-max) | against | ratio (min-max) |", "|---|---|---|---|"]
    for row in rows:
        ratio = row["ratio"]
        shown = f"{ratio['median']:.2f} ({ratio['min']:.2f}-{ratio['max']:.2f})" if ratio else ""
        figures = f"{row['value']:,.4g} ({row['min']:,.4g}-{row['max']:,.4g}) {row['unit']}"
        lines.append(f"| {row['name']} | {figures} | {row['against']} | {shown} |")
    made = rows[0]["made"]
    name = f"`{made['command']}`; commit {made['commit']}; {made['hardware']}; {made['created'][:10]}."
    return [*lines, "", name]


def _table(data: Any) -> list[str]:
    if not isinstance(data, dict):
        return benchmark_table(data)
    return room_table(data) if "seven" in data else experiment_table(data)


def main() -> int:
    """Rewrite README.md."""
    readme = ROOT / "README.md"
    text = readme.read_text("utf-8")
    for file in sorted([*ROOT.glob("experiments/results/*.json"), *ROOT.glob("benchmarks/results/*.json")]):
        data = json.loads(file.read_text("utf-8"))
        table = _table(data)
        marked = re.compile(rf"(<!-- {file.stem} -->\n).*?(<!-- /{file.stem} -->)", re.DOTALL)
        if not marked.search(text):
            print(f"README.md has no place for {file.stem}", file=sys.stderr)
        text = marked.sub(lambda m, table=table: m[1] + "\n".join(table) + "\n" + m[2], text)
    readme.write_text(text, "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
