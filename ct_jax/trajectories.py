"""Trajectories in memory: padded arrays that can be sharded. They do not hold the local maps of mazes.

The local map in a maze is a function of the robot's position, so it is recomputed, exactly, when a window is drawn: a
thousand trajectories take megabytes, not gigabytes. Lidar maps cannot be recomputed: they are kept, with eight cells in
a byte.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int, UInt8

from ct_envs import UserError
from ct_envs.checked import shown
from ct_envs.frames import Symmetries, transform
from ct_envs.maze import Maze
from ct_envs.occupancy import MAP_CELLS, local_map
from ct_jax.runtime import devices
from ct_jax.runtime.files import save_arrays
from ct_jax.types import Rollout, Steps

_PAD_STEPS = 64  # trajectories are padded to a multiple of this many steps
_MAP_SHAPE = (2, MAP_CELLS, MAP_CELLS)
_MAP_BITS = 2 * MAP_CELLS**2

PER_STEP = ("position", "proprio", "action", "label", "reward", "label_mask", "collision")
OBSERVED = ("goal_relative", "map_bits")  # also per step; only in trajectories that keep their maps

# Axes and kinds of the arrays of ``Trajectories``.
_ARRAYS: dict[str, tuple[tuple[str | int, ...], type[np.generic]]] = {
    "position": (("N", "T", 2), np.floating), "proprio": (("N", "T", "P"), np.floating),
    "action": (("N", "T", "A"), np.floating), "label": (("N", "T", "A"), np.floating),
    "reward": (("N", "T"), np.floating), "label_mask": (("N", "T"), np.floating),
    "collision": (("N", "T"), np.floating),
    "goal_world": (("N", 2), np.floating), "maze": (("N",), np.integer), "length": (("N",), np.integer),
    "goal_relative": (("N", "T", 2), np.floating), "map_bits": (("N", "T", -(-_MAP_BITS // 8)), np.uint8),
}  # fmt: skip


# Names of arrays in files of earlier versions.
_NAMES_1 = {"target": "label", "learn": "label_mask", "goal": "goal_world", "seen": "goal_relative"}


@struct.dataclass
class Trajectories:
    """N trajectories of at most T steps; entries at and after ``length`` are padding."""

    position: Float[Array, "N T 2"]  # before the action [m]
    proprio: Float[Array, "N T P"]
    action: Float[Array, "N T A"]  # as intended, without disturbance; input of later steps
    label: Float[Array, "N T A"]  # to be imitated: the action itself, or the planner's (DAgger)
    reward: Float[Array, "N T"]  # after the action
    label_mask: Float[Array, "N T"]  # 1 if the target is to be imitated
    collision: Float[Array, "N T"]
    goal_world: Float[Array, "N 2"]  # final goal [m]
    maze: Int[Array, "N"]  # index into the mazes
    length: Int[Array, "N"]
    # Observations that cannot be recomputed from a maze; both are given or neither.
    goal_relative: Float[Array, "N T 2"] | None = None  # observed vector to the final goal [m]
    map_bits: UInt8[Array, "N T 157"] | None = None  # see ``pack_maps``

    @property
    def n(self) -> int:
        return self.position.shape[0]

    @property
    def rtg(self) -> jax.Array:
        """Return-to-go [N, T]: the sum of rewards from each step to the end."""
        inside = jnp.arange(self.reward.shape[1])[None] < self.length[:, None]
        reward = jnp.where(inside, self.reward, 0.0)
        return jnp.cumsum(reward[:, ::-1], axis=1)[:, ::-1]

    @property
    def nbytes(self) -> int:
        return sum(leaf.nbytes for leaf in jax.tree.leaves(self))


def pack_maps(maps: UInt8[np.ndarray, "*b 2 k k"]) -> UInt8[np.ndarray, "*b 157"]:
    """Local maps with eight cells in a byte."""
    return np.packbits(maps.reshape(*maps.shape[:-3], -1), axis=-1)


def unpack_maps(bits: UInt8[Array, "*b 157"]) -> UInt8[Array, "*b 2 k k"]:
    """The inverse of ``pack_maps``; also works under jit."""
    return jnp.unpackbits(bits, axis=-1, count=_MAP_BITS).reshape(*bits.shape[:-1], *_MAP_SHAPE)


def to_trajectories(rollout: Rollout) -> Trajectories:
    """The record of a rollout as trajectories with final goals.

    Rewards are those of the final goal (paper, sec. III-C). The worlds already give them: their rewards do not depend
    on the waypoints that the controller followed.
    """
    steps = Steps(*(None if leaf is None else np.swapaxes(leaf, 0, 1) for leaf in rollout.steps))
    return Trajectories(
        position=steps.position, proprio=steps.proprio, action=steps.action, label=steps.label, reward=steps.reward,
        label_mask=steps.label_mask * steps.alive, collision=steps.collision * steps.alive,
        goal_world=rollout.goal_world, maze=np.asarray(rollout.place, np.int32),
        length=steps.alive.sum(1).astype(np.int32), goal_relative=steps.goal_relative, map_bits=steps.map_bits,
    )  # fmt: skip


def at_goal(reward: jax.Array | np.ndarray, tolerance_m: float) -> jax.Array | np.ndarray:
    """Whether the robot is at its goal after a step. The reward is minus the distance to the goal [m]."""
    return reward > -tolerance_m


def select(trajectories: Trajectories, index: np.ndarray) -> Trajectories:
    """The trajectories at ``index`` (integers or bools)."""
    return jax.tree.map(lambda leaf: leaf[index], trajectories)


def concatenate(parts: list[Trajectories]) -> Trajectories:
    """All trajectories of ``parts``, padded to the length of the longest."""
    longest = max(int(np.max(np.asarray(part.length), initial=1)) for part in parts)
    fitted = [pad(part, part.n, -(-longest // _PAD_STEPS) * _PAD_STEPS) for part in parts]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *fitted)


def pad(trajectories: Trajectories, n: int, steps: int) -> Trajectories:
    """The same data in arrays of n trajectories and this many steps. Added trajectories are empty and never drawn."""

    def fit(name: str, leaf: np.ndarray) -> np.ndarray:
        if name in (*PER_STEP, *OBSERVED):
            leaf = leaf[:, :steps]
            leaf = np.pad(leaf, [(0, 0), (0, steps - leaf.shape[1])] + [(0, 0)] * (leaf.ndim - 2))
        return np.pad(leaf, [(0, n - leaf.shape[0])] + [(0, 0)] * (leaf.ndim - 1))

    return Trajectories(**{name: fit(name, leaf) for name, leaf in arrays_of(trajectories).items()})


def arrays_of(trajectories: Trajectories) -> dict[str, np.ndarray]:
    """The arrays that are present, by name."""
    leaves = {name: getattr(trajectories, name) for name in Trajectories.__dataclass_fields__}
    return {name: np.asarray(leaf) for name, leaf in leaves.items() if leaf is not None}


def save(trajectories: Trajectories, file: Path) -> None:
    """Write to an ``.npz`` file (no pickle), of which a reader never sees half; several processes write one each."""
    own = _names(file, jax.process_count())[jax.process_index()]
    save_arrays(own, **arrays_of(trajectories))
    devices.largest(0)  # nobody goes on before all are there


def is_saved(file: Path) -> bool:
    """Whether ``save`` has written all of it."""
    return devices.first(lambda: bool(_found(file)))


def load(file: Path) -> Trajectories:
    """Read what ``save`` wrote: each process what it wrote itself, or, where their number is another, an even share.

    Raises:
        UserError: a file is damaged, which the error names.
    """
    files, n, i = _found(file) or [file], jax.process_count(), jax.process_index()
    if len(files) == n:
        return _load(files[i])
    whole = concatenate([_load(each) for each in files])
    return select(whole, np.arange(whole.n * i // n, whole.n * (i + 1) // n))


def _names(file: Path, processes: int) -> list[Path]:
    several = [file.with_name(f"{file.stem}.{i}-of-{processes}{file.suffix}") for i in range(processes)]
    return [file] if processes == 1 else several


def _found(file: Path) -> list[Path]:
    """The files that some number of processes wrote; none if one is missing."""
    counts = {int(part.stem.rpartition("-")[2]) for part in file.parent.glob(f"{file.stem}.0-of-*{file.suffix}")}
    sets = [_names(file, n) for n in sorted({1} | counts)]
    return next((files for files in sets if all(each.is_file() for each in files)), [])


def _load(file: Path) -> Trajectories:
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as data:
            found = {name: data[name] for name in data.files}
    except Exception as bad:  # a torn archive fails in a dozen ways
        raise UserError(f"{file}: not a trajectory file ({type(bad).__name__}); collect again") from None
    found = {_NAMES_1.get(name, name): array for name, array in found.items()}
    wrong = _wrong(found)
    if wrong:
        raise UserError(f"{file}: not a trajectory file ({wrong}); collect again")
    return Trajectories(**found)


def _wrong(found: dict[str, np.ndarray]) -> str:
    """What keeps arrays from being trajectories; empty if nothing does."""
    sizes: dict[str, int] = {}  # of the axes, the same in all arrays
    for name, (axes, kind) in _ARRAYS.items():
        if name not in found:
            if name in OBSERVED and not any(other in found for other in OBSERVED):
                continue
            return f"{name} is missing"
        array = found[name]
        if not np.issubdtype(array.dtype, kind):
            return f"{name} is of {array.dtype}"
        if array.ndim != len(axes) or any(
            size != (axis if isinstance(axis, int) else sizes.setdefault(axis, size))
            for axis, size in zip(axes, array.shape, strict=True)
        ):
            return f"{name} is of shape {array.shape}"
    more = [name for name in found if name not in _ARRAYS]
    if more:
        return f"it holds {shown(more[0])}, too"
    length, steps = found["length"], sizes["T"]
    if not ((length >= 0) & (length <= steps)).all():
        return f"a length is not from 0 to {steps}"
    if (found["maze"] < 0).any():
        return "a maze has a negative number"
    inside = np.arange(steps) < length[:, None]
    for name, (axes, kind) in _ARRAYS.items():
        if name in found and kind is np.floating:
            used = found[name][inside] if "T" in axes else found[name]
            if not np.isfinite(used).all():
                return f"{name} is not finite"
    return ""


@struct.dataclass
class Window:
    """A batch of windows of trajectories, S steps each."""

    map: UInt8[Array, "B S 2 k k"]
    proprio: Float[Array, "B S P"]
    goal_relative: Float[Array, "B S 2"]  # from the robot to the final goal [m]
    action: Float[Array, "B S A"]
    label: Float[Array, "B S A"]
    rtg: Float[Array, "B S"]
    timestep: Int[Array, "B S"]
    valid: Float[Array, "B S"]  # 1 if the step exists, 0 for padding
    label_mask: Float[Array, "B S"]  # 1 if the target is to be imitated
    reward: Float[Array, "B S"]  # after the action


def sample_windows(
    key: jax.Array,
    trajectories: Trajectories,
    rtg: Float[Array, "N T"],
    mazes: Maze | None,
    *,
    batch: int,
    steps: int,
    map_cell_m: float,
    symmetries: Symmetries | None = None,
    shift_timestep: int = 0,
    overhang: int = 0,
    stride: int = 1,
) -> Window:
    """Draw windows of ``steps`` steps. Every step of the data is equally likely to be in one.

    Args:
        rtg: ``trajectories.rtg``, computed once.
        mazes: stacked; ``trajectories.maze`` is an index into it. Not needed if the trajectories keep their maps.
        symmetries: also turn and reflect each window, robot and maze together, by a random symmetry of these.
        shift_timestep: add a random number up to this to a window's timesteps, so that late embeddings are learned.
        overhang: how many steps of a window may lie beyond the end of its trajectory. With ``steps - 1``, the last step
            can also be the first of a window.
        stride: control steps from one step of a window to the next.
    """
    which_key, where_key, mirror_key, shift_key, origin_key = jax.random.split(key, 5)
    share = jnp.cumsum(trajectories.length)
    which = jnp.searchsorted(share, jax.random.randint(which_key, (batch,), 0, share[-1], jnp.int32), side="right")
    length = trajectories.length[which]
    # A window takes every ``stride``-th step of its trajectory, counted from a random one of the first few.
    origin = jax.random.randint(origin_key, (batch,), 0, jnp.minimum(stride, length), jnp.int32)
    count = (length - origin + stride - 1) // stride
    # A window begins at any step that leaves it full, or at the start of a short trajectory. A window that would reach
    # over an end is moved inside. Otherwise the first and last steps would be in fewer windows than the middle ones.
    last, beyond = jnp.maximum(count + overhang - steps, 0), steps - 1 - overhang
    drawn = jax.random.uniform(where_key, (batch,), jnp.float32) * (last + 1 + 2 * beyond)
    first = jnp.clip(drawn.astype(jnp.int32) - beyond, 0, last)
    at = origin[:, None] + stride * (first[:, None] + jnp.arange(steps, dtype=jnp.int32)[None])
    valid = at < length[:, None]
    at = jnp.minimum(at, trajectories.position.shape[1] - 1)
    take = lambda leaf: leaf[which[:, None], at]  # noqa: E731
    if trajectories.map_bits is not None:
        maps, goal = unpack_maps(take(trajectories.map_bits)), take(trajectories.goal_relative)
    else:
        maps, goal = _see(trajectories, mazes, which, take(trajectories.position), map_cell_m)
    window = Window(
        map=maps,
        proprio=take(trajectories.proprio),
        goal_relative=goal,
        action=take(trajectories.action),
        label=take(trajectories.label),
        rtg=take(rtg),
        timestep=at + jax.random.randint(shift_key, (batch, 1), 0, shift_timestep + 1, jnp.int32),
        valid=valid.astype(jnp.float32),
        label_mask=valid * take(trajectories.label_mask),
        reward=take(trajectories.reward),
    )
    if symmetries is None:
        return window
    return mirror_windows(
        jax.random.randint(mirror_key, (batch,), 0, len(symmetries.world), jnp.int32), symmetries, window
    )


def _see(
    trajectories: Trajectories, mazes: Maze | None, which: Int[Array, "B"], position: Float[Array, "B S 2"],
    map_cell_m: float,
) -> tuple[UInt8[Array, "B S 2 k k"], Float[Array, "B S 2"]]:  # fmt: skip
    """Local maps and vectors to the goal [m], at positions [m] in the mazes of the trajectories ``which``."""
    goal = trajectories.goal_world[which]
    maze = jax.tree.map(lambda leaf: leaf[trajectories.maze[which]], mazes)
    see = jax.vmap(lambda m, p, g: local_map(m, p, g, cell_m=map_cell_m), in_axes=(None, 0, None))
    return jax.vmap(see)(maze, position, goal), goal[:, None] - position


def mirror_windows(which: Int[Array, "B"], symmetries: Symmetries, window: Window) -> Window:
    """Apply the symmetries ``which`` of a robot to windows of its trajectories, maps included."""
    world, proprio, action = (jnp.asarray(matrices)[which] for matrices in symmetries)

    def grid(values: jax.Array) -> jax.Array:
        pick = lambda bit, a: jnp.where(bit[:, None, None, None, None], a, values)  # noqa: E731
        values = pick(world[:, 0, 0] == 0, jnp.swapaxes(values, -1, -2))  # x becomes y
        values = pick(world[:, 0].sum(-1) < 0, values[..., ::-1])
        return pick(world[:, 1].sum(-1) < 0, values[..., ::-1, :])

    return window.replace(
        map=grid(window.map),
        proprio=transform(proprio, window.proprio),
        goal_relative=transform(world, window.goal_relative),
        action=transform(action, window.action),
        label=transform(action, window.label),
    )
