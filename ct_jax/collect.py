"""Collecting planner-guided trajectories (paper, Algorithm 3)."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np

from ct_envs import UserError
from ct_envs.checked import Above, Checked, Count, Within
from ct_jax.guided import Guided
from ct_jax.prm import PrmConfig
from ct_jax.runtime.checkpoint import read_json, write_json
from ct_jax.runtime.devices import first as in_first
from ct_jax.runtime.devices import joined, own_rows
from ct_jax.runtime.files import make_folder
from ct_jax.runtime.numerics import with_own_numerics
from ct_jax.trajectories import Trajectories, concatenate, is_saved, load, save, select, to_trajectories
from ct_jax.types import Controller, Guide, Rollout, World

GuideName = Literal["roadmap", "shortcut", "explorer"]


@dataclass(frozen=True)
class CollectConfig(Checked):
    """Planner-guided collection (paper, Algorithm 3 and sec. IV-A). The defaults are the paper's."""

    trajectories: Count = 1000  # T: successes to collect
    reset_interval: Count = 25  # L: episodes on one roadmap
    # The planner: "roadmap" point by point, "shortcut" to visible points, "explorer" without map.
    guide: GuideName = "roadmap"
    # Starts and goals: "vertices" of the roadmap (paper), or free points of the "maze".
    starts: Literal["vertices", "maze"] = "vertices"
    noise: Annotated[float, Within(0, 100)] = 0.0  # standard deviation of a disturbance of actions; it is not imitated
    envs: Annotated[int, Within(1, 100_000)] = 250  # episodes at a time
    horizon: Annotated[int, Within(1, 1_000_000)] = 400  # steps of an episode
    give_up: Annotated[float, Above(0, 1_000_000)] = 10.0  # stop after this many times T episodes


@dataclass(frozen=True)
class Wave:
    """Episodes that ran side by side: this process's share."""

    data: Trajectories
    success: np.ndarray  # bool [N]
    broke_off: np.ndarray  # bool [N]: see ``End.broke_off``


RunWave = Callable[[int], Wave]  # a function of the index of the first episode


@with_own_numerics
def collect(
    key: jax.Array,
    world: World,
    controller: Controller,
    config: CollectConfig,
    prm: PrmConfig,
    *,
    guide: Guide | None = None,
    on_progress: Callable[[int, int], None] = lambda successes, episodes: None,
    keep: Callable[[RunWave], RunWave] = lambda wave: wave,
) -> Trajectories:
    """Algorithm 3: guide pi_c until T episodes have succeeded; only successes are kept.

    Args:
        guide: your own planner; by default the world's planner with the name ``config.guide``.
        on_progress: called with (successes, episodes) so far.
        keep: see ``kept_in``.

    Returns:
        This process's share of the successes.

    Raises:
        UserError: too few successes within ``give_up * T`` episodes.
    """
    policy = Guided(controller, guide or world.guide(config.guide, prm), config.noise)

    def run(first: int) -> Wave:
        tasks = world.sample_tasks(key, config, prm, first=first)
        return as_wave(world.rollout(policy, tasks, horizon=config.horizon))

    return gather(config, keep(run), on_progress)


def as_wave(rollout: Rollout) -> Wave:
    """Episodes as trajectories, and how they ended. Copies count as neither success nor failure."""
    counted, end = rollout.counted, rollout.end
    return Wave(to_trajectories(rollout), counted & end.success, counted & end.broke_off)


def gather(
    config: CollectConfig,
    wave: RunWave,
    on_progress: Callable[[int, int], None],
) -> Trajectories:
    """The loop of Algorithm 3: episodes, wave after wave, until T have succeeded; only successes are kept.

    Args:
        wave: runs ``config.envs`` episodes. The processes' shares are equal.

    Returns:
        This process's share of the successes.

    Raises:
        UserError: too few successes within ``give_up * T`` episodes.
    """
    kept: list[Trajectories] = []
    successes = episodes = 0
    while successes < config.trajectories:
        if episodes >= config.give_up * config.trajectories:
            raise UserError(
                f"the controller reached only {successes} of {episodes} goals, but {config.trajectories} are needed; "
                "train it longer or check its success on edges"
            )
        found = wave(episodes)
        everyone = joined(found.success)
        among = everyone & (successes + np.cumsum(everyone) <= config.trajectories)
        kept.append(select(found.data, own_rows(among)))
        successes, episodes = successes + int(everyone.sum()), episodes + config.envs
        on_progress(successes, episodes)
    return concatenate(kept)


# --------------------------------------------------------------------------------------------- waves that are kept


def kept_in(folder: Path, *, hint: str) -> Callable[[RunWave], RunWave]:
    """Save each wave in a folder. After an interruption, read the saved waves back instead of running them again.

    Args:
        hint: the advice in the error about a damaged file.
    """
    in_first(lambda: make_folder(folder, parents=True))

    def keep(run: RunWave) -> RunWave:
        def read_or_run(first: int) -> Wave:
            file, flags_file = folder / f"{first}.npz", folder / f"{first}.json"
            if not is_saved(file):
                wave = run(first)
                flags = [joined(each).tolist() for each in (wave.success, wave.broke_off)]
                in_first(lambda: write_json(flags_file, {"flags": flags}))
                save(wave.data, file)  # last: this file shows that the wave is complete
                return wave
            try:
                data = load(file)
            except UserError as bad:
                raise UserError(f"{bad}: {hint}") from None
            found = in_first(lambda: read_json(flags_file, hint=hint)).get("flags")
            if not _are_flags(found, joined(np.asarray(data.length)).size):
                raise UserError(f"{flags_file}: not two flags for each episode; {hint}")
            return Wave(data, *own_rows(np.array(found, bool).T).T)

        return read_or_run

    return keep


def _are_flags(found: Any, n: int) -> bool:
    """Whether a value is two lists of n flags."""
    lists = [found, *found] if isinstance(found, list) else [found]
    sizes = [len(each) if isinstance(each, list) else None for each in lists]
    return sizes == [2, n, n] and all(isinstance(flag, bool) for each in found for flag in each)
