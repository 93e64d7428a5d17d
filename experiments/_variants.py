"""What the experiments share: train variants of the method, and gather their rows into one results file."""

import sys
from pathlib import Path
from typing import Any

from ct_jax.checkpoint import read_json, write_json
from ct_jax.cli import prepare_jax, print_rows
from ct_jax.pipeline import train
from ct_jax.presets import Settings
from ct_jax.run import Run, default_mazes, load_mazes

RESULTS = Path(__file__).parent / "results"


def run_variants(
    robot: str, variants: dict[str, Settings], *, preset: str, seeds: tuple[int, ...], out: Path, engine: str = "auto"
) -> list[dict[str, Any]]:
    """Train and evaluate each variant with each seed, continuing what is there; returns all rows."""
    prepare_jax()
    seen, unseen = default_mazes(robot)
    rows = []
    for name, settings in variants.items():
        for seed in seeds:
            run = Run(
                folder=out / f"{name}-{seed}", robot=robot, preset=preset, settings=settings,
                mazes=load_mazes(seen), eval_mazes=load_mazes(unseen), seed=seed, engine=engine,
            )  # fmt: skip
            print(f"== {robot}: {name}, seed {seed}, in {run.folder}", file=sys.stderr)
            train(run, resume=True)
            config = read_json(run.folder / "config.json")
            made = {key: config[key] for key in ("commit", "hardware", "created")}
            wall_s = sum(read_json(done)["wall_s"] for done in sorted(run.folder.glob("*/done.json")))
            for row in read_json(run.folder / "evaluate" / "results.json")["rows"]:
                head = {"variant": name, "model_seed": seed}
                rows.append(head | row | {"run_wall_s": round(wall_s)} | made)
    return rows


def write_results(file: Path, command: str, rows: list[dict[str, Any]]) -> None:
    """Write the rows with the command that made them, and print them."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, {"command": command, "rows": rows})
    print_rows([row | {"method": f"{row['variant']}: {row['method']}"} for row in rows])
    print(f"results: {file}")
