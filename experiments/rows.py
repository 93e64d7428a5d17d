"""The results of the experiments: typed rows, and the files in ``experiments/results``."""

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

import ct_envs.quiet  # noqa: F401
from ct_envs import UserError
from ct_jax.evaluate import GUIDED
from ct_jax.runtime.checkpoint import read_json, write_json

RESULTS = Path(__file__).parent / "results"
CT = "ct"  # the method of all rows of transformers


@dataclass(frozen=True, kw_only=True)
class Origin:
    """The origin of a row."""

    command: str
    commit: str
    hardware: str
    created: str  # ISO date and time
    more: Mapping[str, Any] = field(default_factory=dict, repr=False)  # other keys of the file; no table uses them

    @classmethod
    def read(cls, values: Mapping[str, Any]) -> Self:
        """Read a row from JSON, or the origin from ``provenance`` or a run's ``config.json``.

        Raises:
            UserError: a key is missing.
        """
        names = {each.name for each in fields(cls)} - {"more"}
        more = {name: value for name, value in values.items() if name not in names}
        try:
            return cls(**{name: values[name] for name in names & set(values)}, more=more)
        except TypeError as bad:
            raise UserError(f"not a row of results ({bad}); measure it again") from None

    def values(self) -> dict[str, Any]:
        """The row as flat JSON, without values that are None."""
        own = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "more"}
        return {name: value for name, value in own.items() if value is not None} | dict(self.more)


def origin_of(made: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of ``Origin``, from a run's ``config.json`` or from ``provenance``."""
    return {name: made[name] for name in ("command", "commit", "hardware", "created")}


@dataclass(frozen=True, kw_only=True)
class Scored(Origin):
    """Rates over start-goal pairs."""

    robot: str
    maze: str
    episodes: int
    seed: int  # of the pairs
    success_rate: float
    collision_rate: float = 0.0
    fall_rate: float = 0.0
    frontal_rate: float | None = None  # rooms only
    grazing_rate: float | None = None  # rooms only
    spl: float = 0.0
    return_scaled: float = 0.0
    outcomes: Mapping[str, str] | None = None  # episode by episode as ones and zeros: "success", "collision", ...

    def rate(self, name: str) -> float:
        """The rate with this name: success, collision, fall, frontal or grazing."""
        return getattr(self, f"{name}_rate") or 0.0

    def flags(self, name: str) -> np.ndarray:
        """The outcome of each episode for the rate with this name, 0 or 1 [episodes]."""
        assert self.outcomes is not None
        return np.array([int(digit) for digit in self.outcomes[name]])


@dataclass(frozen=True, kw_only=True)
class Made(Origin):
    """A trained model and a method."""

    variant: str
    model_seed: int
    method: str
    settings: str | None = None  # digest
    controller: str | None = None  # digest of the low-level controller
    run_wall_s: float = 0.0  # all stages of the run
    collect_wall_s: float = 0.0  # collecting the planning trajectories
    learn_wall_s: float | None = None  # training the baseline


@dataclass(frozen=True, kw_only=True)
class Row(Made, Scored):
    """One method of one model, in one maze or in rooms of one density and level of noise."""

    seen: bool | None = None  # whether the model was trained in this maze
    margin_m: float | None = None  # references: clearance of their roadmap beyond the robot's radius
    action_scale: float | None = None  # references: share of the actuators' range that the controller uses
    worlds: int | None = None  # rooms
    pairs: int | None = None  # in each room
    density: float | None = None  # of obstacles, relative to the published density
    noise: float | None = None  # level of noise; 1 is a real robot
    full: int | None = None  # seven pairs: goal reached without contact
    partial: int | None = None  # seven pairs: goal reached with grazing contacts
    failed: int | None = None  # seven pairs: all others
    trained: Mapping[str, Any] | None = None  # origin of the model, if the row was measured later

    @property
    def subject(self) -> tuple[Any, ...]:
        """The key of a row. A later row with the same key replaces it. The key of a reference has no model."""
        model = () if self.method in GUIDED else (self.variant, self.model_seed)
        # Rows of early commits have no ``margin_m``; their margin was 0.
        return (*model, self.method, self.maze, self.density, self.noise, self.margin_m or 0.0, self.action_scale)


@dataclass(frozen=True, kw_only=True)
class Unmade(Made):
    """A missing row, and the reason."""

    why: str


@dataclass(frozen=True, kw_only=True)
class CqlRow(Scored):
    """PT-CQL with one choice of its settings."""

    model_seed: int
    alpha: float
    target_rate: float
    reward_scale: float
    imitation: int
    updates: int


@dataclass(frozen=True, kw_only=True)
class TransferRow(Scored):
    """A transformer after some updates, started from scratch or from the trunk of another robot's model."""

    run: str  # the run whose planning trajectories it learns from
    start: str  # "scratch", or the other robot
    source: str | None = None  # the other robot's run
    updates: int


Kind = TypeVar("Kind", bound=Origin)


@dataclass
class Results:
    """A robot's results file: rows of several commands."""

    rows: list[Row] = field(default_factory=list)
    density: list[Row] = field(default_factory=list)  # rooms of other densities
    noise: list[Row] = field(default_factory=list)  # other levels of noise
    seven: list[Row] = field(default_factory=list)  # the paper's seven pairs
    unmade: list[Unmade] = field(default_factory=list)

    @staticmethod
    def read(file: Path) -> "Results":
        """The results in a file; empty if the file does not exist."""
        found = read_json(file) if file.is_file() else {}
        rows = {name: [Row.read(each) for each in found.get(name, ())] for name in LISTS}
        return Results(**rows, unmade=[Unmade.read(each) for each in found.get("unmade", ())])

    def write(self, file: Path) -> None:
        """Write the lists that are not empty."""
        file.parent.mkdir(parents=True, exist_ok=True)
        lists = {each.name: getattr(self, each.name) for each in fields(self)}
        write_json(file, {name: [row.values() for row in rows] for name, rows in lists.items() if rows})


LISTS = ("rows", "density", "noise", "seven")


def add_results(file: Path, found: Results) -> None:
    """Add results to a file. Existing rows are kept, with two exceptions: new rows replace rows with the same key, and
    rows are dropped if the settings of their variant have changed. Dropped rows are reported on stderr.

    The reason for a missing row is removed once the row exists.
    """
    kept, now = Results.read(file), {}
    for name in LISTS:
        now |= {row.variant: row.settings for row in getattr(found, name)}

    def holds(row: Row) -> bool:
        return row.method in GUIDED or row.settings == now.get(row.variant, row.settings)

    for name in LISTS:
        rows: list[Row] = getattr(found, name)
        again = {row.subject for row in rows}
        before = [row for row in getattr(kept, name) if row.subject not in again]
        for variant, seed in dict.fromkeys((row.variant, row.model_seed) for row in before if not holds(row)):
            print(f"{file}: {name}: dropped {variant}, seed {seed}: its settings have changed", file=sys.stderr)
        setattr(kept, name, [row for row in before if holds(row)] + rows)
    done = {(row.variant, row.model_seed) for row in found.rows}
    told = {(each.variant, each.model_seed) for each in found.unmade}
    kept.unmade = [each for each in kept.unmade if (each.variant, each.model_seed) not in done | told] + found.unmade
    kept.write(file)


def replace_rows(file: Path, rows: Iterable[Kind], names: tuple[str, ...], kind: type[Kind]) -> list[Kind]:
    """Write rows to a file. They replace rows with the same values of ``names``. Returns all rows of the file."""
    rows = list(rows)
    subject = lambda row: tuple(getattr(row, name) for name in names)  # noqa: E731
    again = set(map(subject, rows))
    together = [row for row in read_rows(file, kind) if subject(row) not in again] + rows
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, {"rows": [row.values() for row in together]})
    return together


def read_rows(file: Path, kind: type[Kind]) -> list[Kind]:
    """The rows of a file with one list; empty if the file does not exist."""
    return [kind.read(each) for each in read_json(file)["rows"]] if file.is_file() else []
