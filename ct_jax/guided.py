"""The controller guided by a planner (paper, sec. III-A): the teacher of the transformer."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from ct_jax.types import Action, Controller, Frame, Guide, act_as_intended


@struct.dataclass
class Guided:
    """At every step the controller heads for the guide's waypoint. Memory: the guide's, and the disturbance [N, A]."""

    controller: Controller
    guide: Guide = struct.field(pytree_node=False)
    noise: float = struct.field(pytree_node=False, default=0.0)  # standard deviation of the disturbance of actions
    hold: float = struct.field(pytree_node=False, default=0.9)  # chance that the disturbance is kept for another step

    def init(self, frame: Frame, tasks: Any) -> tuple[Any, jax.Array]:
        """The memory before the first step."""
        n = frame.done.shape[0]
        return self.guide.init(frame, tasks), jnp.zeros((n, self.controller.action_size), jnp.float32)

    def act(self, memory: tuple[Any, jax.Array], frame: Frame, key: jax.Array) -> tuple[Action, tuple[Any, jax.Array]]:
        """Actions towards the waypoints, and the next memory. The disturbance is executed, but not imitated."""
        plan, disturbance = memory
        waypoint, plan = self.guide.waypoint(plan, frame)
        action = self.controller(frame.obs.proprio, waypoint)
        if not self.noise:
            return act_as_intended(action), (plan, disturbance)
        keep_key, new_key = jax.random.split(key)
        keep = jax.random.bernoulli(keep_key, jnp.float32(self.hold), disturbance.shape[:1])[:, None]
        drawn = self.noise * jax.random.normal(new_key, disturbance.shape, jnp.float32)
        disturbance = jnp.where(keep, disturbance, drawn)
        return act_as_intended(action)._replace(executed=action + disturbance), (plan, disturbance)
