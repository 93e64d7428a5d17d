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
    names = [
        "maze",
        "model",
        "method",
        "success %",
        "SPL",
        "return / 100",
        "collided %",
        *(["fell %"] if falls else []),
    ]
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


def main() -> int:
    """Rewrite README.md."""
    readme = ROOT / "README.md"
    text = readme.read_text("utf-8")
    for file in sorted([*ROOT.glob("experiments/results/*.json"), *ROOT.glob("benchmarks/results/*.json")]):
        data = json.loads(file.read_text("utf-8"))
        table = experiment_table(data) if isinstance(data, dict) else benchmark_table(data)
        marked = re.compile(rf"(<!-- {file.stem} -->\n).*?(<!-- /{file.stem} -->)", re.DOTALL)
        if not marked.search(text):
            print(f"README.md has no place for {file.stem}", file=sys.stderr)
        text = marked.sub(lambda m, table=table: m[1] + "\n".join(table) + "\n" + m[2], text)
    readme.write_text(text, "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
