"""The low-level controllers that the package ships: takes over those of finished runs, and shows how they were learned.

    python experiments/controllers.py [--ship runs/ant/cpu-ct-0]

A shipped controller is what ``--controller zoo`` means: the weights, and in ``controller.json`` its settings, the
command, commit and machine that made it, its success on held-out edges as its training went on, and how long that took.
Writes the table between README's markers and the picture ``docs/controllers.png``.
"""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
ZOO = ROOT / "ct_jax" / "zoo" / "controllers"
PICTURE = ROOT / "docs" / "controllers.png"
ENOUGH = 0.97  # of the held-out edges


@dataclass(frozen=True)
class Options:
    """What to do besides the table and the picture."""

    ship: tuple[Path, ...] = ()
    """Runs whose controllers the package is to ship, instead of those it has of their robots."""


def ship(run: Path) -> None:
    """Take over a run's controller, with the curve of its training.

    Raises:
        UserError: the run has none that is finished.
    """
    from ct_envs import UserError
    from ct_jax.checkpoint import read_json, write_json

    folder = run / "controller"
    if not (folder / "done.json").is_file():
        raise UserError(f"{run}: has no finished controller of its own; train it, or go on with --resume")
    robot = read_json(folder / "controller.json")["robot"]
    (ZOO / robot).mkdir(exist_ok=True)
    shutil.copy(folder / "weights.safetensors", ZOO / robot)
    write_json(ZOO / robot / "controller.json", described(run))


def described(run: Path) -> dict[str, Any]:
    """A run's ``controller.json``, with its training's wall time [s] and, by iteration, success on held-out edges.

    Raises:
        UserError: the run took over its controller from another.
    """
    from ct_envs import UserError
    from ct_jax.checkpoint import read_json

    found = read_json(run / "controller" / "controller.json")
    lines = map(json.loads, (run / "metrics.jsonl").read_text("utf-8").splitlines())
    tests = {line["step"]: line["held_out"] for line in lines if line["stage"] == "controller" and "held_out" in line}
    if not tests:
        raise UserError(f"{run}: its controller was learned in another run; give that one")
    wall_s = read_json(run / "controller" / "done.json")["wall_s"]
    return found | {"made": found["made"] | {"wall_s": wall_s, "curve": sorted(tests.items())}}


def minutes(found: dict[str, Any]) -> list[tuple[float, float]]:
    """The curve by time [min]: every iteration takes as long as any other."""
    made = found["made"]
    return [(made["wall_s"] / 60 * step / found["sac"]["iterations"], rate) for step, rate in made.get("curve", ())]


def table(controllers: list[dict[str, Any]]) -> list[str]:
    """A line for each controller."""
    names = ["robot", "held-out edges", "twenty in a row", "updates", "minutes", f"{ENOUGH:.0%} of the edges after"]
    lines = ["| " + " | ".join([*names, "made by"]) + " |", "|---" * (len(names) + 1) + "|"]
    for found in controllers:
        made, sac = found["made"], found["sac"]
        first = next((f"{at:.0f} min" for at, rate in minutes(found) if rate >= ENOUGH), "")
        rates = [f"{100 * made[name]:.1f}" if name in made else "" for name in ("held_out_success", "twenty_in_a_row")]
        wall = f"{made['wall_s'] / 60:.0f}" if "wall_s" in made else ""
        by = f"`{made['command']}`; commit {made['commit']}; {made['hardware']}; {made['created'][:10]}"
        updates = f"{sac['iterations'] * sac['updates']:,}"
        lines.append("| " + " | ".join([found["robot"], *rates, updates, wall, first, by]) + " |")
    return lines


def draw(controllers: list[dict[str, Any]], file: Path) -> None:
    """Success on held-out edges against time."""
    from matplotlib.figure import Figure

    figure = Figure((5.2, 3.8), layout="constrained")
    ax = figure.add_subplot()
    for found in controllers:
        if curve := minutes(found):
            label = f"{found['robot']}, {found['made']['hardware']}"
            ax.plot([at for at, _ in curve], [100 * rate for _, rate in curve], marker=".", label=label)
    ax.axhline(100 * ENOUGH, color="grey", lw=0.8, ls="--")
    ax.set(xlabel="training [min]", ylabel="held-out edges walked in time [%]", ylim=(0, 101), xscale="log")
    ax.grid(alpha=0.3)
    ax.xaxis.set_major_formatter("{x:g}")
    figure.legend(loc="outside upper center")
    figure.savefig(file, dpi=150)


def main() -> int:
    """Run from the command line; returns the exit status."""
    import tyro
    from table import put

    from ct_jax.checkpoint import read_json
    from ct_jax.cli import guarded

    def run() -> None:
        for each in tyro.cli(Options, description=__doc__).ship:
            ship(each)
        controllers = [read_json(file) for file in sorted(ZOO.glob("*/controller.json"))]
        readme = ROOT / "README.md"
        lines = table(controllers)
        readme.write_text(put(readme.read_text("utf-8"), "controllers", lines), "utf-8")
        draw(controllers, PICTURE)
        print("\n".join(lines))

    return guarded(run)


if __name__ == "__main__":
    from ct_jax.cli import leave

    leave(main())
