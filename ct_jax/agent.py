"""A trained policy that acts on your own observations: of another simulator, a recording, or a robot."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ct_envs import UserError
from ct_envs.checked import shown
from ct_envs.occupancy import MAP_CELLS
from ct_jax.policy import TransformerPolicy
from ct_jax.runtime.numerics import with_own_numerics
from ct_jax.types import AnyArray, Frame, Observation, Privileged


@dataclass(frozen=True, eq=False)
class Agent:
    """A policy for N episodes at once, all of them at the same step.

    An observation is a dict, as ``MazeEnv`` and ``Turtlebot3`` give it: ``map`` [N, 2, 25, 25] (uint8, 0 or 1),
    ``proprio`` [N, P] and ``goal`` [N, 2] (floats; the vector from the robot to its goal, m). Each batch size compiles
    once. Observations are checked on the host, so that an agent does not run inside ``jax.jit``; its ``policy`` does.
    """

    policy: TransformerPolicy
    robot: str
    proprio_size: int
    _memories: dict[int, Any] = field(default_factory=dict, init=False, repr=False)  # shapes, by batch size

    @with_own_numerics
    def init(self, observation: Mapping[str, Any]) -> Any:
        """The memory at the start of N episodes.

        Raises:
            UserError: an entry is missing, or is of a wrong shape or type, or is not finite.
        """
        return self.policy.init(self._frame(observation))

    @with_own_numerics
    def act(self, memory: Any, observation: Mapping[str, Any], reward: Any) -> tuple[Float[AnyArray, "N A"], Any]:
        """The next actions, in [-1, 1], and the memory after them.

        Args:
            memory: of ``init``, or of the step before.
            reward: [N], since the last action: minus the distance to the goal [m]. 0 at the first step.

        Raises:
            UserError: as ``init``; or the memory is of another model or batch size.
        """
        frame = self._frame(observation, reward)
        self._check_memory(memory, frame)
        action, memory = self.policy.act(memory, frame, jax.random.key(0))
        return action.executed, memory

    def _frame(self, observation: Mapping[str, Any], reward: Any = None) -> Frame:
        """What a policy may see. Raises UserError."""
        shapes = {"map": (2, MAP_CELLS, MAP_CELLS), "proprio": (self.proprio_size,), "goal": (2,)}
        if not isinstance(observation, Mapping):
            raise UserError(f"the observation is a {type(observation).__name__}; give a dict of {', '.join(shapes)}")
        for name in shapes:
            if name not in observation:
                raise UserError(f"the observation has no '{name}'; give a dict of {', '.join(shapes)}")
        arrays = {name: self._array(name, observation[name], shape) for name, shape in shapes.items()}
        n = len(arrays["map"])
        arrays["reward"] = np.zeros(n, np.float32) if reward is None else self._array("reward", reward, ())
        for name, array in arrays.items():
            if len(array) != n:
                raise UserError(f"'{name}' is of {len(array)} episodes, 'map' of {n}; give as many of each")
        reward = arrays.pop("reward")
        seen = Observation(arrays["map"], arrays["proprio"], arrays["goal"])
        nothing = Privileged(None, None, None, None)  # pyright: ignore[reportArgumentType]
        return Frame(seen, reward, np.zeros(n, bool), nothing)  # pyright: ignore[reportArgumentType]

    def _array(self, name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
        """The checked entry [N, *shape] as the policy takes it. Raises UserError."""
        wanted = f"[{', '.join(['N', *map(str, shape)])}]"
        if isinstance(value, jax.core.Tracer):
            raise UserError(f"'{name}' is traced by jax; inside jax.jit, use the agent's policy instead of the agent")
        try:
            array = np.asarray(value)
        except (TypeError, ValueError):
            raise UserError(f"'{name}' is {shown(value)}; give an array {wanted}") from None
        if array.shape[1:] != shape or not array.ndim or not len(array):
            raise UserError(f"'{name}' has shape {array.shape}; the {self.robot} needs {wanted} for N episodes, N >= 1")
        if name == "map":
            if array.dtype != np.uint8:
                raise UserError(f"'map' is of type {array.dtype}; give uint8")
            if array.max() > 1:
                raise UserError(f"'map' holds {array.max()}; give 0 and 1 only")
            return array
        if not jnp.issubdtype(array.dtype, jnp.floating):
            raise UserError(f"'{name}' is of type {array.dtype}; give float32")
        with np.errstate(over="ignore"):
            array = array.astype(np.float32)
        finite = np.isfinite(array).reshape(len(array), -1).all(1)
        if not finite.all():
            raise UserError(f"'{name}' is not finite in row {int(np.argmin(finite))}; give numbers that are")
        return array

    def _check_memory(self, memory: Any, frame: Frame) -> None:
        """Raise UserError for a memory that is not of this policy, or of another number of episodes."""
        n = len(frame.done)
        if n not in self._memories:
            self._memories[n] = jax.eval_shape(self.policy.init, frame)
        wanted = self._memories[n]
        alike = jax.tree.structure(memory) == jax.tree.structure(wanted)
        if not alike or [np.shape(x) for x in jax.tree.leaves(memory)] != [x.shape for x in jax.tree.leaves(wanted)]:
            raise UserError(f"the memory is of another model or batch size; give what init or act returned for N = {n}")
