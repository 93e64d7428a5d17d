"""The one scan that steps environments under a policy."""

import functools
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from brax.envs.base import State
from flax import struct
from jax.sharding import Mesh
from jaxtyping import Array, Float

from ct_envs import MazeEnv
from ct_envs.maze import Maze
from ct_jax.devices import sharded


class Action(NamedTuple):
    """What a policy meant to do, what is done (they differ by a disturbance), and what should be imitated."""

    meant: Float[Array, "N A"]
    done: Float[Array, "N A"]
    target: Float[Array, "N A"]
    learn: Float[Array, "N"]  # 1 where the target is to be imitated, else 0


def act_as_meant(action: Float[Array, "N A"]) -> Action:
    """An action without disturbance, itself to be imitated."""
    return Action(action, action, action, jnp.ones(action.shape[:1], jnp.float32))


class Policy(Protocol):
    """Acts in N environments at once. A pytree; its memory of the episode is another."""

    def act(self, memory: Any, state: State, key: jax.Array) -> tuple[Action, Any]:
        """Actions for N states, and the memory after them."""
        ...


@struct.dataclass
class Steps:
    """What happened, time first: [T, N, ...]. State before the action, outcome after it."""

    position: Float[Array, "T N 2"]
    proprio: Float[Array, "T N P"]
    action: Float[Array, "T N A"]  # as meant; 0 where that is not finite
    target: Float[Array, "T N A"]  # to be imitated; 0 where it is not finite
    reward: Float[Array, "T N"]
    learn: Float[Array, "T N"]  # 1 where the target is to be imitated and finite
    alive: Float[Array, "T N"]  # 1 where the episode was still running before the action
    success: Float[Array, "T N"]
    collision: Float[Array, "T N"]


def broke_off(info: dict[str, Any]) -> Float[Array, "*b"]:
    """1 where an episode ended by a fall or because something was not finite, else 0. (The last step's ``info``.)

    Both end the losses of a robot that has not arrived. Wherever returns are compared they are paid alike: as if the
    robot stayed where it is until the horizon.
    """
    return jnp.maximum(info["fall"], info["diverged"])


@functools.partial(jax.jit, static_argnames=("env", "length", "mesh"))
def rollout(
    env: MazeEnv, policy: Policy, state: State, memory: Any, key: jax.Array, length: int, mesh: Mesh | None = None
) -> tuple[State, Any, Steps]:
    """Step N environments ``length`` times (static). Environments without auto-reset stay where they finished.

    Args:
        mesh: the devices that share the environments evenly. Which device steps one changes nothing of what happens.
    """
    step = jax.vmap(env.step)
    if mesh is not None and mesh.size > 1:  # each steps its own: XLA would not split the calls of MuJoCo by itself
        spec = sharded(mesh).spec
        step = jax.shard_map(step, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)

    def once(carry: tuple[State, Any], key: jax.Array) -> tuple[tuple[State, Any], Steps]:
        state, memory = carry
        action, memory = policy.act(memory, state, key)
        after = step(state, action.done)
        # One number that is not finite, in a past action or in a target, would make all that is learned so.
        usable = jnp.all(jnp.isfinite(action.target), -1)
        record = Steps(
            position=state.info["position"],
            proprio=state.obs["proprio"],  # pyright: ignore[reportArgumentType]
            action=jnp.where(jnp.isfinite(action.meant), action.meant, 0.0),
            target=jnp.where(usable[:, None], action.target, 0.0),
            reward=after.reward,
            learn=jnp.where(usable, action.learn, 0.0),
            alive=1.0 - state.done,
            success=after.info["success"],
            collision=after.info["collision"],
        )
        return (after, memory), record

    (state, memory), steps = jax.lax.scan(once, (state, memory), jax.random.split(key, length))
    if mesh is not None:
        steps = jax.lax.with_sharding_constraint(steps, sharded(mesh, axis=1))
    return state, memory, steps


class Controller(Protocol):
    """pi_c. A pytree, so that its parameters are arguments of compiled programs."""

    action_size: int

    def __call__(self, proprio: Float[Array, "N P"], goal: Float[Array, "N 2"]) -> Float[Array, "N A"]:
        """Actions from proprioception and the vector to a goal close by [m]."""
        ...


class Guide(Protocol):
    """A planner, asked at every step for the next waypoint."""

    def waypoint(
        self, memory: Any, maze: Maze, position: Float[Array, "N 2"], goal: Float[Array, "N 2"]
    ) -> tuple[Float[Array, "N 2"], Any]:
        """Targets [m], and the guide's memory after them."""
        ...


@struct.dataclass
class Guided:
    """The controller led by a planner (paper, sec. III-A). Its memory is (the guide's, the disturbance [N, A])."""

    controller: Controller
    guide: Guide = struct.field(pytree_node=False)
    noise: float = struct.field(pytree_node=False, default=0.0)  # size of the disturbance of the actions
    hold: float = struct.field(pytree_node=False, default=0.9)  # chance that it stays as it is for another step

    def init(self, state: State, guide_memory: Any) -> tuple[Any, jax.Array]:
        n = state.done.shape[0]
        return guide_memory, jnp.zeros((n, self.controller.action_size), jnp.float32)

    def intend(self, guide_memory: Any, state: State) -> tuple[jax.Array, Any]:
        """What the controller would do, undisturbed."""
        position = state.info["position"]
        target, guide_memory = self.guide.waypoint(guide_memory, state.info["maze"], position, state.info["goal"])
        return self.controller(state.obs["proprio"], target - position), guide_memory  # pyright: ignore

    def act(self, memory: tuple[Any, jax.Array], state: State, key: jax.Array) -> tuple[Action, Any]:
        guide_memory, disturbance = memory
        action, guide_memory = self.intend(guide_memory, state)
        if not self.noise:
            return act_as_meant(action), (guide_memory, disturbance)
        keep_key, new_key = jax.random.split(key)
        keep = jax.random.bernoulli(keep_key, jnp.float32(self.hold), disturbance.shape[:1])[:, None]
        drawn = self.noise * jax.random.normal(new_key, disturbance.shape, jnp.float32)
        disturbance = jnp.where(keep, disturbance, drawn)
        return act_as_meant(action)._replace(done=action + disturbance), (guide_memory, disturbance)
