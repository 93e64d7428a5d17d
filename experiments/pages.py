"""Writes the results pages: all of docs/results, and the tables in README.md, docs/speed.md and docs/models.

    python experiments/pages.py

Every number comes from ``experiments/results``, ``benchmarks/results`` or ``ct_jax/zoo``; none is typed by hand. In
README.md, docs/speed.md and docs/models a table stands between ``<!-- NAME -->`` and ``<!-- /NAME -->``. The plots in
docs/results are drawn anew, too.
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
from ct_jax.files import prepare_outputs, write_text

ROOT = Path(__file__).parents[1]
BENCHMARKS, DOCS = ROOT / "benchmarks" / "results", ROOT / "docs"
PAGES = DOCS / "results"
WRITTEN = "<!-- Written by `python experiments/pages.py`. Do not edit. -->"
HOW = "How each row was made"
SWEPT = {"density": "density of obstacles / the published one", "noise": "level of noise"}  # with the axis' label


def page(title: str, *parts: str | Sequence[str]) -> str:
    """A fully generated page, from its paragraphs and tables; empty ones are left out."""
    texts = [part.strip() if isinstance(part, str) else "\n".join(part) for part in parts]
    return "\n\n".join([f"# {title}", WRITTEN, *filter(None, texts)]) + "\n"


INDEX = """
Success of every method on fixed start-goal pairs, with intervals. `python experiments/pages.py` writes these pages
from the files in `experiments/results`. Each page ends with the command, commit, seeds, machine and date that made
each of its rows. [Reproducing](../reproducing.md) says how to make them again.

| page | what |
|---|---|
| [Point](point.md), [ant](ant.md), [humanoid](humanoid.md) | all methods in the seen and the unseen mazes |
| [Turtlebot3](turtlebot3.md) | all methods in random rooms; other densities, noise, seven pairs |
| [Fine-tuning](fine-tuning.md) | F-CT − CT on more pairs and in more mazes |
| [Transfer](transfer.md) | what a trained trunk is worth to another robot |
| [PT-CQL's settings](pt-cql.md) | how they were chosen |
| [Low-level controllers](controllers.md) | the controllers that ship with the package |
| [Speed](../speed.md) | the benchmarks |
"""

CACHED = """
Rows as published (*CT*, *BC-CT*, *F-CT*; `ct`, `bc-ct`, `f-ct` of the Turtlebot3) were measured with a key/value cache,
whose memory reaches `layers x (K - 1) + 1` steps. [Method](../method.md#acting) says why that matters.
"""

COLUMNS = """
| column | what it means |
|---|---|
| success % | episodes that reached the goal; of several trained models together |
| each model | success of each trained model, by seed |
| SPL | success weighted by path length: 1 is the shortest way in every episode |
| return / 100 | minus the distance to the goal, summed over all steps, divided by 100 |
| collided % | episodes that touched something at least once |
| frontal %, grazing % | Turtlebot3: ran into something ahead; touched something with its side |
| fell % | episodes that ended with the robot on its side or back |
| full, partial, failed | seven pairs: arrived and touched nothing; arrived and grazed something; the rest |

*planner* knows the whole map. *explorer* draws a map from the local maps that the transformer also sees, and replans:
it is the alternative to a learned policy. Both lead the same low-level controller. "0.3 m margin" is what their
roadmap keeps off walls beyond the robot's radius; "action scale 0.75" is the share of the actuators' range that the
controller uses.
"""


def index_page(results: Mapping[str, Results]) -> str:
    """The first page of the results."""
    summary = summary_table(results)
    return page("Results", INDEX, "## Summary", summary, CACHED, "## Columns", COLUMNS)


MAZES = """
*CT*, *BC-CT*, *F-CT*, *PT-CQL* and *SAC alone* are the methods of the paper. Names in `code` are lifted variants: the
model has the same size and meets the same pairs. `experiments/{robot}.py` holds what each variant changes;
[robots](../robots.md#{robot}) discusses the results; [the columns](index.md#columns) are explained on the first page.
"""

ROOMS = """
*ct*, *bc-ct* and *f-ct* are the methods as published; the others are lifted. `experiments/turtlebot3.py` holds what
each variant changes; [robots](../robots.md#turtlebot3) discusses the results; [the columns](index.md#columns) are
explained on the first page.
"""


def maze_page(robot: str, results: Mapping[str, Results]) -> str:
    """A maze robot's page, with every preset that was measured."""
    variants, parts = load_variants(robot), []
    for name, found in results.items():
        of, _, preset = name.rpartition("-")
        if of != robot:
            continue
        parts += [f"## Preset {preset}", maze_tables(found, variants)]
        if gains := differences(found, variants):
            parts += [f"### What fine-tuning adds ({preset})", "Pair by pair, of the same models:", gains]
        if missing := reasons(found.unmade, variants):
            parts += [f"### Rows that there are not ({preset})", missing]
        parts += [f"### {HOW} ({preset})", runs_table(found.rows, variants)]
        if (PAGES / f"{name}.png").is_file():
            parts += [f"### A run's report ({preset})", f"![The report of a run of preset {preset}]({name}.png)"]
    return page(f"Results: {robot}", MAZES.format(robot=robot), *parts)


def room_page(results: Results) -> str:
    """The Turtlebot3's page."""
    plots = [f"![Success against the {axis} of the rooms](turtlebot3-{axis}.png)" for axis in SWEPT]
    every = [*results.rows, *results.density, *results.noise, *results.seven]
    made = runs_table(every, load_variants("turtlebot3"))
    report = "![The report of the run `cpu`](turtlebot3-cpu.png)"
    return page(
        "Results: Turtlebot3", ROOMS, room_tables(results), "## Plots", *plots, f"## {HOW}", made, "## A run's report",
        report,
    )  # fmt: skip


FINETUNED = """
More pairs than the robots' tables have, of another seed, in unseen mazes. `validation-1` to `validation-3` are mazes
for choosing settings. A model is compared with CT of the same seed and the same low-level controller, on the same
pairs. `long-ct` is CT with about as many updates as F-CT has in all.
"""


def finetuned_page(rows: Sequence[Row]) -> str:
    """F-CT − CT on more pairs."""

    def model(row: Row) -> tuple[str, ...]:
        trained = row.trained or {}
        return row.robot, f"`{row.variant}`", str(row.model_seed), f"{trained['commit']}, {trained['hardware']}"

    note = f"Pairs of seed {rows[0].seed}. {INTERVALS}"
    made = made_by(rows, ("robot", "variant", "seed", "model made by"), model)
    return page("What fine-tuning adds", FINETUNED, finetuned_table(rows, load_variants), note, f"## {HOW}", made)


TRANSFER = """
A new transformer is fitted to the planning trajectories of a robot's run, from scratch or from the trunk of the other
robot's model (paper, sec. IV-A). The last column says after how many updates it reached 90 % of the final success,
which is the better start's after the last update.
"""


def transfer_page(rows: Sequence[TransferRow]) -> str:
    """The page about transfer to another robot."""
    picture = (
        "![Success in the unseen maze against updates, from scratch and from the other robot's trunk](transfer.png)"
    )
    note = f"Success in % after so many updates: {rows[0].episodes} pairs in the unseen maze, mean of the seeds. The "
    note += "picture shows means and ranges of the seeds."
    curve = lambda row: (row.robot, f"`{row.run}`", start_of(row), str(row.seed))  # noqa: E731
    made = made_by(rows, ("robot", "run", "start", "seed"), curve)
    return page("Transfer to another robot", TRANSFER, transfer_table(rows), note, picture, f"## {HOW}", made)


def cql_page(rows: Sequence[CqlRow]) -> str:
    """How PT-CQL's settings were chosen."""
    about = "PT-CQL's settings were chosen in the training maze, on pairs that no other table uses."
    note = f"{rows[0].episodes} pairs of seed {rows[0].seed} in {rows[0].maze}. {INTERVALS}"
    made = made_by(rows, ("robot", "model seed"), lambda row: (row.robot, str(row.model_seed)))
    return page("PT-CQL's settings", about, cql_table(rows), note, f"## {HOW}", made)


CONTROLLERS = """
The low-level controllers that ship with the package (`--controller zoo`). *Held-out edges* are roadmap edges that no
training saw. *Twenty in a row* is the share of twenty edges, one after the other without a reset, that were all
walked.
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
    """The descriptions (``controller.json``) of the shipped controllers."""
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
    """A hand-written page, with new tables between its markers."""
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
