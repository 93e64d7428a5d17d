"""Writes the table of statistics in docs/unseen-maze.md, and draws docs/unseen-maze.png.

    python experiments/unseen_maze.py

It needs no results: both come from the generators alone. Takes ten seconds.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from pages import filled
from tables import grid

from ct_envs import measure_maze
from ct_envs.generators import GENERATORS
from ct_envs.unseen import TEST_MAZES, generator_of, test_maze, test_pairs, training_maze
from ct_jax.cli import guarded, leave
from ct_jax.runtime.files import prepare_outputs, whole, write_text

DOCS = Path(__file__).parents[1] / "docs"
PAGE, PICTURE = DOCS / "unseen-maze.md", DOCS / "unseen-maze.png"
PAIRS = 5  # of each maze
DEEP_STEPS = 3  # a trap of 12 m, more than the 4 to 8 m that the memory of 64 steps covers
EXAMPLES = (0, 75, 152, 263, 1061)  # numbers within a generator, for the picture


def statistics_table() -> list[str]:
    """Statistics of the test mazes and their first pairs: a Markdown table, one line per generator and one for all."""
    mazes = [measure_maze(test_maze(number)) for number in range(TEST_MAZES)]
    pairs = [test_pairs(number, PAIRS) for number in range(TEST_MAZES)]
    names = [
        "generator", "free share of the inner cells", "loops (cycle rank)", "loops around walls", "dead ends",
        "longest way [steps]", "deepest trap [steps]", f"pairs: trap of {DEEP_STEPS} steps or more",
        f"mazes with such a trap in {PAIRS} pairs",
    ]  # fmt: skip
    body = []
    for name in (*GENERATORS, "all"):
        chosen = [i for i in range(TEST_MAZES) if name in (generator_of(i), "all")]
        free, rank, islands, dead_ends, longest, trap = np.array([mazes[i] for i in chosen]).T
        deep = np.array([pairs[i].trap_steps >= DEEP_STEPS for i in chosen])
        shares = (f"{100 * share:.0f} %" for share in (deep.mean(), deep.any(1).mean()))
        counts = (f"{x.mean():.1f} ({x.min():.0f} to {x.max():.0f})" for x in (rank, islands, dead_ends, longest, trap))
        body.append((name, f"{free.mean():.2f} ({free.min():.2f} to {free.max():.2f})", *counts, *shares))
    return grid(names, body)


def draw_examples(file: Path) -> None:
    """Training mazes of every generator, a row each, cells of one size."""
    figure = Figure(figsize=(10, 8.4), layout="constrained")
    axes = figure.subplots(len(GENERATORS), len(EXAMPLES))
    for row, generator in zip(axes, GENERATORS, strict=True):
        for ax, number in zip(row, EXAMPLES, strict=True):
            walls = training_maze(number, generator)
            ax.imshow(walls, cmap="binary", origin="lower", interpolation="none")
            ax.set_title(f"{generator} {number}: {walls.shape[0]} x {walls.shape[1]}", fontsize=8)
            ax.set_axis_off()
    with whole(file) as opened:
        figure.savefig(opened, format="png", dpi=100)


def main() -> None:
    """Write the table and the picture."""
    prepare_outputs(PAGE, PICTURE)
    for file, text in filled(PAGE, {"statistics": statistics_table()}).items():
        write_text(file, text)
    draw_examples(PICTURE)


if __name__ == "__main__":
    leave(guarded(main))
