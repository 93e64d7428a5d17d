"""Write the results pages: all of docs/results, and the tables in README.md, docs/speed.md and docs/models.

    python experiments/pages.py

Every number comes from ``experiments/results``, ``benchmarks/results`` or ``ct_jax/zoo``; none is typed by hand. In
README.md, docs/speed.md and docs/models each table is between ``<!-- NAME -->`` and ``<!-- /NAME -->``. The plots in
docs/results are drawn again, too.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from intervals import INTERVALS
from plots import draw_controllers, draw_sweep, draw_transfer, line_of, start_of
from rows import RESULTS, CqlRow, Results, Row, TransferRow, read_rows
from study import ROBOTS, load_variants
from tables import (
    ZOO,
    benchmark_table,
    controllers_table,
    cql_table,
    differences,
    finetuned_table,
    made_by,
    maze_tables,
    model_card,
    put,
    reasons,
    room_tables,
    runs_table,
    summary_table,
    transfer_table,
)

from ct_jax.cli import guarded, leave
from ct_jax.runtime.files import prepare_outputs, write_text

ROOT = Path(__file__).parents[1]
BENCHMARKS, DOCS = ROOT / "benchmarks" / "results", ROOT / "docs"
PAGES = DOCS / "results"
WRITTEN = "<!-- Written by `python experiments/pages.py`. Do not edit. -->"
HOW = "How each row was made"
SWEPT = {"density": "density of obstacles / the published one", "noise": "level of noise"}  # axes and their labels


def page(title: str, *parts: str | Sequence[str]) -> str:
    """A generated page from its paragraphs and tables. Empty parts are left out."""
    texts = [part.strip() if isinstance(part, str) else "\n".join(part) for part in parts]
    return "\n\n".join([f"# {title}", WRITTEN, *filter(None, texts)]) + "\n"


INDEX = """
Success rates of all methods on fixed start-goal pairs, with intervals. `python experiments/pages.py` writes these pages
from the files in `experiments/results`. Each page ends with the command, commit, seeds, machine and date of each row.
[Reproducing](../reproducing.md) describes how to repeat the measurements.

| page | content |
|---|---|
| [Point](point.md), [ant](ant.md), [humanoid](humanoid.md) | all methods in the seen and the unseen mazes |
| [Turtlebot3](turtlebot3.md) | all methods in random rooms; other densities, noise, seven pairs |
| [Fine-tuning](fine-tuning.md) | F-CT − CT on more pairs and in more mazes |
| [Transfer](transfer.md) | training that starts from the trunk of another robot's model |
| [PT-CQL's settings](pt-cql.md) | how the settings were chosen |
| [Low-level controllers](controllers.md) | the controllers that ship with the package |
| [Speed](../speed.md) | the benchmarks |
"""

CACHED = """
The rows as published (*CT*, *BC-CT*, *F-CT*; `ct`, `bc-ct`, `f-ct` of the Turtlebot3) were measured with a key/value
cache. Its memory reaches back `layers x (K - 1) + 1` steps. [Method](../method.md#acting) explains the difference from
the paper.
"""

COLUMNS = """
| column | meaning |
|---|---|
| success % | share of episodes that reached the goal, over all trained models |
| each model | success rate of each trained model, in the order of the seeds |
| SPL | success weighted by path length: 1 means the shortest path in every episode |
| return / 100 | minus the distance to the goal, summed over all steps, divided by 100 |
| collided % | share of episodes in which the robot touched something |
| frontal %, grazing % | Turtlebot3: share of episodes with a contact at the front; with a contact at the side |
| fell % | share of episodes that ended with a fall |
| full, partial, failed | seven pairs: goal reached without contact; goal reached with grazing contacts; all others |

*planner* knows the whole map. *explorer* builds a map from the local maps that the transformer also sees, and replans.
Both guide the same low-level controller. "0.3 m margin" is the clearance of their roadmap beyond the robot's radius.
"action scale 0.75" is the share of the actuators' range that the controller uses.
"""


def index_page(results: Mapping[str, Results]) -> str:
    """The first page of the results."""
    summary = summary_table(results)
    return page("Results", INDEX, "## Summary", summary, CACHED, "## Columns", COLUMNS)


MAZES = """
*CT*, *BC-CT*, *F-CT*, *PT-CQL* and *SAC alone* are the methods of the paper. Names in `code` are lifted variants with
the same model size and the same start-goal pairs. `experiments/{robot}.py` lists what each variant changes.
[Robots](../robots.md#{robot}) discusses the results. [Results](index.md#columns) explains the columns.
"""

ROOMS = """
*ct*, *bc-ct* and *f-ct* are the methods as published. The others are lifted variants. `experiments/turtlebot3.py`
lists what each variant changes. [Robots](../robots.md#turtlebot3) discusses the results.
[Results](index.md#columns) explains the columns.
"""


def maze_page(robot: str, results: Mapping[str, Results]) -> str:
    """The page of a robot in mazes, with all measured presets."""
    variants, parts = load_variants(robot), []
    for name, found in results.items():
        of, _, preset = name.rpartition("-")
        if of != robot:
            continue
        parts += [f"## Preset {preset}", maze_tables(found, variants)]
        if gains := differences(found, variants):
            about = "Differences are computed for each start-goal pair and each model:"
            parts += [f"### Gain from fine-tuning ({preset})", about, gains]
        if missing := reasons(found.unmade, variants):
            parts += [f"### Missing rows ({preset})", missing]
        parts += [f"### {HOW} ({preset})", runs_table(found.rows, variants)]
        if (PAGES / f"{name}.png").is_file():
            parts += [f"### Report of a run ({preset})", f"![The report of a run of preset {preset}]({name}.png)"]
    return page(f"Results: {robot}", MAZES.format(robot=robot), *parts)


def room_page(results: Results) -> str:
    """The Turtlebot3's page."""
    plots = [f"![Success against the {axis} of the rooms](turtlebot3-{axis}.png)" for axis in SWEPT]
    every = [*results.rows, *results.density, *results.noise, *results.seven]
    made = runs_table(every, load_variants("turtlebot3"))
    report = "![The report of the run `cpu`](turtlebot3-cpu.png)"
    return page(
        "Results: Turtlebot3", ROOMS, room_tables(results), "## Plots", *plots, f"## {HOW}", made, "## Report of a run",
        report,
    )  # fmt: skip


FINETUNED = """
These rows have more start-goal pairs than the robots' pages, of a different seed, in unseen mazes. `validation-1` to
`validation-3` are mazes for choosing settings. F-CT is compared with CT of the same seed and the same low-level
controller, on the same pairs. `long-ct` is CT with about the same total number of updates as F-CT.
"""


def finetuned_page(rows: Sequence[Row]) -> str:
    """F-CT − CT on more pairs."""

    def model(row: Row) -> tuple[str, ...]:
        trained = row.trained or {}
        return row.robot, f"`{row.variant}`", str(row.model_seed), f"{trained['commit']}, {trained['hardware']}"

    note = f"Pairs of seed {rows[0].seed}. {INTERVALS}"
    made = made_by(rows, ("robot", "variant", "seed", "origin of the model"), model)
    return page("Gain from fine-tuning", FINETUNED, finetuned_table(rows, load_variants), note, f"## {HOW}", made)


TRANSFER = """
A new transformer is trained on the planning trajectories of a robot's run, either from scratch or from the trunk of the
other robot's model (paper, sec. IV-A). The last column is the number of updates after which it reached 90 % of the
final success rate. The final success rate is that of the better start after the last update.
"""


def transfer_page(rows: Sequence[TransferRow]) -> str:
    """The page about transfer to another robot."""
    picture = (
        "![Success in the unseen maze against updates, from scratch and from the other robot's trunk](transfer.png)"
    )
    note = f"Success in % by number of updates: {rows[0].episodes} pairs in the unseen maze, mean over the seeds. The "
    note += "plot shows the means and the ranges over the seeds."
    curve = lambda row: (row.robot, f"`{row.run}`", start_of(row), str(row.seed))  # noqa: E731
    made = made_by(rows, ("robot", "run", "start", "seed"), curve)
    return page("Transfer to another robot", TRANSFER, transfer_table(rows), note, picture, f"## {HOW}", made)


def cql_page(rows: Sequence[CqlRow]) -> str:
    """How PT-CQL's settings were chosen."""
    about = "The settings of PT-CQL were chosen in the training maze, on pairs that no other table uses."
    note = f"{rows[0].episodes} pairs of seed {rows[0].seed} in {rows[0].maze}. {INTERVALS}"
    made = made_by(rows, ("robot", "model seed"), lambda row: (row.robot, str(row.model_seed)))
    return page("PT-CQL's settings", about, cql_table(rows), note, f"## {HOW}", made)


CONTROLLERS = """
The low-level controllers that ship with the package (`--controller zoo`). *Held-out edges* are roadmap edges that are
not used in training. *Twenty in a row* is the success rate on sequences of twenty edges without a reset in between.
"""


def controllers_page(controllers: Sequence[Mapping[str, Any]]) -> str:
    """The low-level controllers that ship."""
    picture = "![Success on held-out edges against minutes of training](controllers.png)"
    return page("Low-level controllers", CONTROLLERS, controllers_table(controllers), picture)


# ------------------------------------------------------------------------------------------------------------- all


def load_results() -> dict[str, Results]:
    """The robots' results by the names of their files."""
    files = sorted(file for robot in ROBOTS for file in RESULTS.glob(f"{robot}-*.json"))
    return {file.stem: Results.read(file) for file in files}


def load_controllers() -> list[dict[str, Any]]:
    """The files ``controller.json`` of the shipped controllers."""
    return [json.loads(file.read_text("utf-8")) for file in sorted(ZOO.glob("controllers/*/controller.json"))]


def pages() -> dict[Path, str]:
    """All pages by file."""
    results = load_results()
    found = {
        PAGES / "index.md": index_page(results),
        PAGES / "turtlebot3.md": room_page(results["turtlebot3-cpu"]),
        PAGES / "fine-tuning.md": finetuned_page(read_rows(RESULTS / "finetuned.json", Row)),
        PAGES / "transfer.md": transfer_page(read_rows(RESULTS / "transfer.json", TransferRow)),
        PAGES / "pt-cql.md": cql_page(read_rows(RESULTS / "cql.json", CqlRow)),
        PAGES / "controllers.md": controllers_page(load_controllers()),
    }
    found |= {PAGES / f"{robot}.md": maze_page(robot, results) for robot in ROBOTS if robot != "turtlebot3"}
    found |= filled(ROOT / "README.md", {"summary": summary_table(results)})
    files = sorted(BENCHMARKS.glob("*.json"))
    found |= filled(DOCS / "speed.md", {f.stem: benchmark_table(json.loads(f.read_text("utf-8"))) for f in files})
    for robot in ROBOTS:
        found |= filled(DOCS / "models" / f"{robot}.md", model_card(robot, results[f"{robot}-cpu"]))
    return found


def filled(file: Path, tables: Mapping[str, Sequence[str]]) -> dict[Path, str]:
    """A page written by hand, with new tables between its markers."""
    text = file.read_text("utf-8")
    for name, lines in tables.items():
        text = put(text, name, lines)
    return {file: text}


def plots() -> dict[Path, Callable[[], None]]:
    """Functions that draw the plots, by file."""
    found = load_results()["turtlebot3-cpu"]
    drawn: dict[Path, Callable[[], None]] = {}
    for axis, label in SWEPT.items():
        swept: list[Row] = getattr(found, axis)
        lines = {line_of(row) for row in swept}
        rows, file = swept + [row for row in found.rows if line_of(row) in lines], PAGES / f"turtlebot3-{axis}.png"
        drawn[file] = lambda rows=rows, axis=axis, label=label, file=file: draw_sweep(rows, axis, label, file)
    curves, file = read_rows(RESULTS / "transfer.json", TransferRow), PAGES / "transfer.png"
    drawn[file] = lambda: draw_transfer(curves, PAGES / "transfer.png")
    drawn[PAGES / "controllers.png"] = lambda: draw_controllers(load_controllers(), PAGES / "controllers.png")
    return drawn


def main() -> None:
    """Write all pages and plots."""
    texts, drawn = pages(), plots()
    prepare_outputs(*texts, *drawn)
    for file, text in texts.items():
        write_text(file, text)
    for draw in drawn.values():
        draw()


if __name__ == "__main__":
    leave(guarded(main))
