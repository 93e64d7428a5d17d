"""Evaluation on fixed start-goal pairs: success, return, SPL, collisions and time-outs, with intervals."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from ct_envs import UserError
from ct_jax.guided import Guided
from ct_jax.pairs import Pairs, beyond_horizon
from ct_jax.prm import PrmConfig
from ct_jax.runtime.devices import joined
from ct_jax.runtime.numerics import with_own_numerics
from ct_jax.types import Controller, OnProgress, Policy, Rollout, World

METHODS = ("ct", "planner", "explorer")
GUIDED = ("planner", "explorer")  # a planner guides the controller; everything else is a policy that was learned
MAX_HORIZON = 1_000_000
RETURN_UNIT = 100.0  # the paper's scaled return is the raw one over this


@dataclass(frozen=True)
class Episodes:
    """What one method did on the pairs."""

    success: np.ndarray  # bool [n]
    collided: np.ndarray  # bool [n]: touched a wall at any step
    fell: np.ndarray  # bool [n]
    timeout: np.ndarray  # bool [n]: neither arrived nor broke off
    steps: np.ndarray  # [n]
    returns: np.ndarray  # [n], raw; after a fall, or where it diverged, the robot lies where it is until the horizon
    travelled_m: np.ndarray  # [n]
    path: np.ndarray  # float32 [T, n, 2]: positions before each step, for pictures
    pairs: Pairs
    wall_s: float
    horizon: int  # control steps of an episode
    target_return: np.ndarray | None = None  # return that the policy was conditioned on at the start
    proprio: np.ndarray | None = None  # float32 [T, P]: of the first episode, for a video
    frontal: np.ndarray | None = None  # bool [n]: frontal collision, where the world distinguishes it from
    grazing: np.ndarray | None = None  # bool [n]: a touch with the robot's side
    not_joined: int | None = None  # of a planner: pairs that its roadmap does not join
    beyond: int = 0  # pairs too far apart for the robot to make within the horizon
    diverged: np.ndarray | None = None  # bool [n]: a state or action was not finite, where that ends an episode

    def summary(self) -> dict[str, Any]:
        """Rates and means; intervals are 95 %: Wilson for rates, bootstrap over episodes for means."""
        spl = self.success * self.pairs.shortest_m / np.maximum(self.pairs.shortest_m, self.travelled_m)
        rows: dict[str, Any] = {"success_rate": float(self.success.mean()), "success_ci95": wilson(self.success)}
        rows |= {"return_mean": float(self.returns.mean()), "return_ci95": bootstrap(self.returns)}
        rows |= {"return_scaled": float(self.returns.mean() / RETURN_UNIT)}
        rows |= {"return_scaled_ci95": [x / RETURN_UNIT for x in bootstrap(self.returns)]}
        rows |= {"spl": float(spl.mean()), "spl_ci95": bootstrap(spl)}
        rows |= {"collision_rate": float(self.collided.mean()), "collision_ci95": wilson(self.collided)}
        rows |= {"fall_rate": float(self.fell.mean()), "fall_ci95": wilson(self.fell)}
        rows |= {"timeout_rate": float(self.timeout.mean()), "timeout_ci95": wilson(self.timeout)}
        for name in ("frontal", "grazing", "diverged"):
            told = getattr(self, name)
            rows |= {} if told is None else {f"{name}_rate": float(told.mean()), f"{name}_ci95": wilson(told)}
        rows |= {"horizon": self.horizon, "beyond_horizon": self.beyond, "straight_ways": self.pairs.straight}
        rows |= {} if self.not_joined is None else {"not_joined": self.not_joined}
        return rows | {"steps_mean": float(self.steps.mean()), "wall_s": round(self.wall_s, 2)}


def wilson(outcomes: np.ndarray) -> list[float]:
    """95 % interval of a rate."""
    return wilson_of(int(np.sum(outcomes)), len(outcomes))


def wilson_of(successes: int, tries: int) -> list[float]:
    """The same from counts."""
    interval = stats.binomtest(successes, tries).proportion_ci(0.95, method="wilson")
    return [float(interval.low), float(interval.high)]


def bootstrap(values: np.ndarray) -> list[float]:
    """95 % interval of a mean (percentile bootstrap, fixed seed)."""
    if len(values) < 2 or np.ptp(values) == 0:
        return [float(np.mean(values))] * 2
    result = stats.bootstrap((values,), np.mean, n_resamples=2000, rng=np.random.default_rng(0), method="percentile")
    return [float(result.confidence_interval.low), float(result.confidence_interval.high)]


def check_horizon(horizon: int | None) -> None:
    """Raises UserError for a horizon that is given and out of its range."""
    if horizon is not None and not 1 <= horizon <= MAX_HORIZON:
        raise UserError(f"--horizon {horizon}: give a number of control steps from 1 to {MAX_HORIZON}")


@with_own_numerics
def evaluate(
    world: World,
    pairs: Pairs,
    method: str,
    *,
    policy: Policy | None = None,
    controller: Controller | None = None,
    prm: PrmConfig | None = None,
    horizon: int | None = None,
    on_progress: OnProgress = lambda over, note: None,
) -> Episodes:
    """Run one method on all pairs.

    Args:
        world: with local maps.
        pairs: ``world.draw_pairs``, or one's own.
        method: "planner" (has the full map), "explorer" (sees local maps); both need ``controller``; or
            any name for ``policy``.
        prm: the planner's roadmap, and its margins.
        horizon: control steps of an episode; by default the world's.

    Raises:
        UserError: pairs that are not of that world.
    """
    begun, horizon = time.perf_counter(), horizon or world.horizon
    prm = prm or PrmConfig()
    tasks, not_joined = world.tasks_of(pairs, prm if method == "planner" else None)
    if method in GUIDED:
        assert controller is not None
        policy = Guided(controller, world.guide("shortcut" if method == "planner" else method, prm))
    assert policy is not None
    rollout = world.rollout(policy, tasks, horizon=horizon, on_progress=on_progress)
    return _outcome(
        rollout, pairs, time.perf_counter() - begun, not_joined, beyond_horizon(world.robot, pairs, horizon)
    )


def _outcome(rollout: Rollout, pairs: Pairs, wall_s: float, not_joined: int | None, beyond: int) -> Episodes:
    """What happened to the pairs, from each process's own episodes."""
    steps, end, n = rollout.steps, rollout.end, len(pairs.start)
    path = np.concatenate([steps.position, end.position[None]])
    # After an episode broke off, the robot lies where it is until the horizon.
    lying = end.broke_off * end.reward * (rollout.horizon - steps.alive.sum(0))
    touched = lambda flags: None if flags is None else (flags * steps.alive).sum(0) > 0  # noqa: E731
    each = {
        "success": end.success,
        "collided": touched(steps.collision),
        "fell": end.fell,
        "diverged": end.diverged,
        "timeout": ~end.success & ~end.broke_off,
        "steps": steps.alive.sum(0),
        "returns": (steps.reward * steps.alive).sum(0) + lying,
        "travelled_m": np.linalg.norm(np.diff(path, axis=0), axis=-1).sum(0),
        "target_return": None if steps.target_return is None else steps.target_return[0],
        "frontal": touched(steps.frontal),
        "grazing": touched(steps.grazing),
    }
    each = {name: None if rows is None else joined(rows)[:n] for name, rows in each.items()}
    every_path = joined(np.swapaxes(steps.position, 0, 1))[:n]
    return Episodes(
        **each, path=np.swapaxes(every_path, 0, 1), pairs=pairs, wall_s=wall_s, horizon=rollout.horizon,
        proprio=joined(steps.proprio[None, :, 0])[0], not_joined=not_joined, beyond=beyond,
    )  # fmt: skip
