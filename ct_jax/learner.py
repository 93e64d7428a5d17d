"""Learners: what all trainings have in common.

A learner is a pytree with ``create`` and ``update``. Its settings are static, its arrays are all that a checkpoint
needs, and ``step`` counts its updates. Made from its settings alone it has no arrays yet: ``create`` gives it them.
"""

import functools
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from ct_jax.runtime.checkpoint import Checkpoints, run_to
from ct_jax.runtime.devices import replicated

Info = dict[str, jax.Array]  # what an update reports, each a number


class Learner(Protocol):
    """Learns from data by updates."""

    step: Any

    @property
    def mesh(self) -> Mesh:
        """The devices that share a batch."""
        ...

    def update(self, *data: Any) -> tuple[Any, Info]:
        """The learner after one update on the data, and what it reports."""
        ...


L = TypeVar("L", bound=Learner)


@functools.cache
def updates_on(mesh: Mesh) -> Callable[..., tuple[Any, Info]]:
    """The compiled loop of many updates: (learner, *data, updates=n) to the learner and its mean report."""

    def many(learner: L, *data: Any, updates: int) -> tuple[L, Info]:
        learner, info = jax.lax.scan(lambda learner, _: learner.update(*data), learner, length=updates)
        return learner, jax.tree.map(jnp.mean, info)

    return jax.jit(many, static_argnames="updates", out_shardings=replicated(mesh))


def train(learner: L, updates: int, *data: Any) -> tuple[L, Info]:
    """Run ``updates`` updates on the data; returns the learner and its mean report."""
    return updates_on(learner.mesh)(learner, *data, updates=updates)


def learn(
    learner: L,
    total: int,
    *data: Any,
    on_progress: Callable[[int, dict[str, float]], None],
    checkpoints: Checkpoints | None,
    chunk: int,
) -> L:
    """Train until there were ``total`` updates.

    Args:
        on_progress: called with (updates done, mean report since the last call) after every ``chunk``.
        checkpoints: training continues from the last one, saves one at intervals, and saves one when interrupted.
    """
    return run_to(
        total, learner, lambda learner, n: train(learner, n, *data), lambda learner: int(learner.step), on_progress,
        checkpoints, chunk,
    )  # fmt: skip
