"""Rolling out a policy in a compiled environment: the scan that steps N episodes side by side."""

import functools
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from brax.envs.base import State
from jax.sharding import Mesh
from jaxtyping import Array, Float

from ct_envs.robots import Robot
from ct_jax.runtime.devices import sharded
from ct_jax.types import Frame, Observation, Policy, Privileged, Steps


class Environment(Protocol):
    """What is used of a ``ct_envs.MazeEnv``: a brax environment whose reset takes a maze and tasks."""

    robot: Robot
    horizon: int
    map_cell_m: float

    @property
    def proprio_size(self) -> int: ...

    @property
    def action_size(self) -> int: ...

    def reset(self, rng: jax.Array, maze: Any = None, tasks: Any = None) -> State:
        """The first state of an episode."""
        ...

    def step(self, state: State, action: jax.Array) -> State:
        """The state after a control step. Its ``info`` is that of ``MazeEnv``."""
        ...


def broke_off(info: dict[str, Any]) -> Float[Array, "*b"]:
    """1 where an episode ended by a fall or because something was not finite, else 0. (The last step's ``info``.)"""
    return jnp.maximum(info["fall"], info["diverged"])


def as_frame(state: State) -> Frame:
    """What the interfaces say of a state of ``MazeEnv``."""
    obs: dict[str, jax.Array] = state.obs  # pyright: ignore[reportAssignmentType]
    info = state.info
    return Frame(
        Observation(obs.get("map"), obs["proprio"], obs["goal"]), state.reward, state.done > 0,
        Privileged(info["position"], info["goal"], info["collision"], info["maze"]),
    )  # fmt: skip


@functools.partial(jax.jit, static_argnames=("env", "length", "mesh"))
def run(
    env: Environment, policy: Policy, state: State, memory: Any, key: jax.Array, length: int, mesh: Mesh | None = None
) -> tuple[State, Any, Steps]:
    """Step N environments ``length`` times (static). Without auto-reset, an environment stays in its final state.

    Args:
        mesh: the devices that share the environments evenly. The result does not depend on it.
    """
    step: Callable = jax.vmap(env.step)
    if mesh is not None and mesh.size > 1:  # each device steps its share: XLA cannot split the calls of MuJoCo itself
        spec = sharded(mesh).spec
        step = jax.shard_map(step, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)

    def once(carry: tuple[State, Any], key: jax.Array) -> tuple[tuple[State, Any], Steps]:
        state, memory = carry
        frame = as_frame(state)
        action, memory = policy.act(memory, frame, key)
        after = step(state, action.executed)
        # One number that is not finite, in a past action or in a label, would spoil all that is learned from them.
        usable = jnp.all(jnp.isfinite(action.label), -1)
        record = Steps(
            position=frame.privileged.position,
            proprio=frame.obs.proprio,
            action=jnp.where(jnp.isfinite(action.intended), action.intended, 0.0),
            label=jnp.where(usable[:, None], action.label, 0.0),
            label_mask=jnp.where(usable, action.label_mask, 0.0),
            reward=after.reward,
            alive=1.0 - state.done,
            collision=after.info["collision"],
            success=after.info["success"],
            target_return=action.target_return,
        )  # pyright: ignore[reportArgumentType]
        return (after, memory), record

    (state, memory), steps = jax.lax.scan(once, (state, memory), jax.random.split(key, length))
    if mesh is not None:
        steps = jax.lax.with_sharding_constraint(steps, sharded(mesh, axis=1))
    return state, memory, steps
