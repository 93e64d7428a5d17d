"""Rolling out a policy in the maze environments: the one scan that steps them."""

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
    """The action that a policy intended, the action executed (with a disturbance), and the action to imitate."""

    intended: Float[Array, "N A"]
    executed: Float[Array, "N A"]
    label: Float[Array, "N A"]
    label_mask: Float[Array, "N"]  # 1 if the target is to be imitated, else 0


def act_as_intended(action: Float[Array, "N A"]) -> Action:
    """An action that is executed without disturbance and imitated as it is."""
    return Action(action, action, action, jnp.ones(action.shape[:1], jnp.float32))


class Policy(Protocol):
    """Acts in N environments at once. The policy and its memory of the episode are two pytrees."""

    def act(self, memory: Any, state: State, key: jax.Array) -> tuple[Action, Any]:
        """Actions for N states, and the next memory."""
        ...


@struct.dataclass
class Steps:
    """The record of a rollout, time first: [T, N, ...]. States are before the action, outcomes after it."""

    position: Float[Array, "T N 2"]
    proprio: Float[Array, "T N P"]
    action: Float[Array, "T N A"]  # as intended, without disturbance; 0 where that is not finite
    label: Float[Array, "T N A"]  # to be imitated; 0 where it is not finite
    reward: Float[Array, "T N"]
    label_mask: Float[Array, "T N"]  # 1 where the target is to be imitated and finite
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
    """Step N environments ``length`` times (static). Without auto-reset, an environment stays in its final state.

    Args:
        mesh: the devices that share the environments evenly. The result does not depend on it.
    """
    step = jax.vmap(env.step)
    if mesh is not None and mesh.size > 1:  # each device steps its share: XLA cannot split the calls of MuJoCo itself
        spec = sharded(mesh).spec
        step = jax.shard_map(step, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)

    def once(carry: tuple[State, Any], key: jax.Array) -> tuple[tuple[State, Any], Steps]:
        state, memory = carry
        action, memory = policy.act(memory, state, key)
        after = step(state, action.executed)
        # One number that is not finite, in a past action or in a target, would make all that is learned so.
        usable = jnp.all(jnp.isfinite(action.label), -1)
        record = Steps(
            position=state.info["position"],
            proprio=state.obs["proprio"],  # pyright: ignore[reportArgumentType]
            action=jnp.where(jnp.isfinite(action.intended), action.intended, 0.0),
            label=jnp.where(usable[:, None], action.label, 0.0),
            reward=after.reward,
            label_mask=jnp.where(usable, action.label_mask, 0.0),
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
    """The low-level controller pi_c. It is a pytree, so its parameters are arguments of compiled programs."""

    action_size: int

    def __call__(self, proprio: Float[Array, "N P"], goal: Float[Array, "N 2"]) -> Float[Array, "N A"]:
        """Actions from proprioception and the vector to a nearby goal [m]."""
        ...


class Guide(Protocol):
    """A planner. It gives the next waypoint at every step."""

    def waypoint(
        self, memory: Any, maze: Maze, position: Float[Array, "N 2"], goal: Float[Array, "N 2"]
    ) -> tuple[Float[Array, "N 2"], Any]:
        """Targets [m], and the guide's next memory."""
        ...


@struct.dataclass
class Guided:
    """The controller guided by a planner (paper, sec. III-A). Memory: the guide's memory, the disturbance [N, A]."""

    controller: Controller
    guide: Guide = struct.field(pytree_node=False)
    noise: float = struct.field(pytree_node=False, default=0.0)  # standard deviation of the disturbance of actions
    hold: float = struct.field(pytree_node=False, default=0.9)  # chance that the disturbance is kept for another step

    def init(self, state: State, guide_memory: Any) -> tuple[Any, jax.Array]:
        n = state.done.shape[0]
        return guide_memory, jnp.zeros((n, self.controller.action_size), jnp.float32)

    def intend(self, guide_memory: Any, state: State) -> tuple[jax.Array, Any]:
        """The controller's action without disturbance."""
        position = state.info["position"]
        target, guide_memory = self.guide.waypoint(guide_memory, state.info["maze"], position, state.info["goal"])
        return self.controller(state.obs["proprio"], target - position), guide_memory  # pyright: ignore

    def act(self, memory: tuple[Any, jax.Array], state: State, key: jax.Array) -> tuple[Action, Any]:
        guide_memory, disturbance = memory
        action, guide_memory = self.intend(guide_memory, state)
        if not self.noise:
            return act_as_intended(action), (guide_memory, disturbance)
        keep_key, new_key = jax.random.split(key)
        keep = jax.random.bernoulli(keep_key, jnp.float32(self.hold), disturbance.shape[:1])[:, None]
        drawn = self.noise * jax.random.normal(new_key, disturbance.shape, jnp.float32)
        disturbance = jnp.where(keep, disturbance, drawn)
        return act_as_intended(action)._replace(executed=action + disturbance), (guide_memory, disturbance)
