"""Copy the low-level controllers of finished runs into the package, so that they ship with it.

    python experiments/controllers.py --ship runs/ant/cpu-ct-0

``--controller zoo`` uses a shipped controller. It consists of the weights and ``controller.json``, which contains the
settings, command, commit and machine of its training, the training time, and the success on held-out edges over time.
``experiments/pages.py`` writes ``docs/results/controllers.md`` from these files.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

import ct_envs.quiet  # noqa: F401
from ct_envs import UserError
from ct_jax.cli import guarded, leave
from ct_jax.runtime.checkpoint import read_json, write_json
from ct_jax.runtime.files import prepare_outputs, whole

ZOO = Path(__file__).parents[1] / "ct_jax" / "zoo" / "controllers"


@dataclass(frozen=True)
class Options:
    """What to ship."""

    ship: tuple[Path, ...] = ()
    """Runs whose controllers to ship. They replace the shipped controllers of the same robots."""


def ship(run: Path) -> None:
    """Copy a run's controller into the package, with its learning curve.

    Raises:
        UserError: the run has no finished controller of its own.
    """
    folder = run / "controller"
    if not (folder / "done.json").is_file():
        raise UserError(f"{run}: has no finished controller of its own; train one, or continue the run with --resume")
    robot = read_json(folder / "controller.json")["robot"]
    weights, description = ZOO / robot / "weights.safetensors", ZOO / robot / "controller.json"
    prepare_outputs(weights, description)
    with whole(weights) as opened:
        opened.write((folder / "weights.safetensors").read_bytes())
    write_json(description, described(run))


def described(run: Path) -> dict[str, Any]:
    """A run's ``controller.json``, with the training time [s] and the success on held-out edges by iteration.

    Raises:
        UserError: the run did not train its controller.
    """
    found = read_json(run / "controller" / "controller.json")
    lines = map(json.loads, (run / "metrics.jsonl").read_text("utf-8").splitlines())
    tests = {line["step"]: line["held_out"] for line in lines if line["stage"] == "controller" and "held_out" in line}
    if not tests:
        raise UserError(f"{run}: its controller was trained in another run; give that run")
    wall_s = read_json(run / "controller" / "done.json")["wall_s"]
    return found | {"made": found["made"] | {"wall_s": wall_s, "curve": sorted(tests.items())}}


def main(options: Options) -> None:
    """Ship the controllers, and print all shipped ones."""
    for run in options.ship:
        ship(run)
    for file in sorted(ZOO.glob("*/controller.json")):
        made = read_json(file)["made"]
        print(f"{file.parent.name}: {made['command']}, commit {made['commit']}")
    print("pages: python experiments/pages.py writes them to docs/results")


if __name__ == "__main__":
    leave(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
