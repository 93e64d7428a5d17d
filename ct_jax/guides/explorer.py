"""The explorer: a classical planner that sees the same local maps as the transformer. It is the reference.

It remembers each maze cell that its local maps have shown, and assumes that all other cells are free. At every step it
heads for a visible cell on the shortest path to the goal in that map. Unlike the transformer, it also knows its
position and the size and alignment of the maze's cells.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from ct_envs.maze import Maze, cell_of, in_sight, is_wall, segment_reach
from ct_envs.occupancy import MAP_CELLS
from ct_jax.types import Frame


@struct.dataclass
class Seen:
    """The cells of the maze that have been seen."""

    cells: Bool[Array, "N H W"]


@dataclass(frozen=True)
class ExplorerGuide:
    """Optimistic replanning on the cells seen so far, for N environments at once."""

    radius_m: float
    map_cell_m: float
    cell_m: float
    look_m: float = 10.0  # largest distance of a waypoint [m]; the controller was trained on edges up to this length

    def init(self, frame: Frame, tasks: Any = None) -> Seen:
        """The memory before anything is seen."""
        del tasks
        return Seen(jnp.zeros(frame.privileged.scene.walls.shape, bool))

    def waypoint(self, seen: Seen, frame: Frame) -> tuple[Float[Array, "N 2"], Seen]:
        """Vectors to the waypoints [N, 2] (m), and the cells seen so far."""
        maze, position, goal = frame.privileged.scene, frame.privileged.position, frame.privileged.goal_world
        seen = Seen(seen.cells | jax.vmap(self._shown)(maze, position))
        believed = maze.replace(walls=maze.walls & seen.cells)
        to_go = path_lengths(believed, goal)
        return jax.vmap(self._choose)(believed, to_go, position, goal) - position, seen

    def _shown(self, maze: Maze, position: jax.Array) -> jax.Array:
        """Cells of which the local map at ``position`` shows at least one point."""
        offset = (jnp.arange(MAP_CELLS, dtype=jnp.float32) - (MAP_CELLS - 1) / 2) * self.map_cell_m
        column, row = jnp.floor((position[:, None] + offset[None]) / maze.cell_m).astype(jnp.int32)
        height, width = maze.shape
        rows = jnp.any(row[:, None] == jnp.arange(height)[None], 0)
        columns = jnp.any(column[:, None] == jnp.arange(width)[None], 0)
        return rows[:, None] & columns[None, :]

    def _choose(self, believed: Maze, to_go: jax.Array, position: jax.Array, goal: jax.Array) -> jax.Array:
        side = jnp.arange(-2, 3, dtype=jnp.int32)
        offsets = jnp.stack(jnp.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
        cells = cell_of(believed, position)[None] + offsets
        points = jnp.concatenate([goal[None], (cells[:, ::-1] + 0.5) * believed.cell_m])
        height, width = believed.shape
        on_grid = to_go[jnp.clip(cells[:, 0], 0, height - 1), jnp.clip(cells[:, 1], 0, width - 1)]
        rest = jnp.concatenate([jnp.zeros(1, jnp.float32), jnp.where(is_wall(believed, cells), jnp.inf, on_grid)])
        away = jnp.linalg.norm(points - position[None], axis=-1)
        reach = segment_reach(self.look_m, self.radius_m, self.cell_m)
        free = jax.vmap(lambda p: in_sight(believed, position, p, radius=self.radius_m, reach=reach))(points)
        # If two paths are equally long, take the farther waypoint: a robot at a cell's centre must not stay there.
        # If no point is visible, take the centre of the robot's own cell.
        usable = (free & (away <= self.look_m)) | (jnp.arange(len(points)) == 1 + len(offsets) // 2)
        return points[jnp.argmin(jnp.where(usable, 0.999 * away + rest, jnp.inf))]


def path_lengths(maze: Maze, goal: jax.Array) -> Float[Array, "N H W"]:
    """Path lengths [m] from cell centres to goals [N, 2] (m), over 4-connected free cells (value iteration)."""
    height, width = maze.shape
    cell = jax.vmap(cell_of)(maze, goal)
    rows, columns = jnp.arange(height)[None, :, None], jnp.arange(width)[None, None]
    at_goal = (rows == cell[:, :1, None]) & (columns == cell[:, 1:, None])
    last = jnp.linalg.norm((cell[:, ::-1] + 0.5) * maze.cell_m[:, None] - goal, axis=-1)
    cost = jnp.where(maze.walls, jnp.inf, maze.cell_m[:, None, None])
    start = jnp.where(at_goal, last[:, None, None], jnp.inf)

    def sweep(carry):
        d, _ = carry
        p = jnp.pad(d, ((0, 0), (1, 1), (1, 1)), constant_values=jnp.inf)
        near = jnp.minimum(jnp.minimum(p[:, :-2, 1:-1], p[:, 2:, 1:-1]), jnp.minimum(p[:, 1:-1, :-2], p[:, 1:-1, 2:]))
        new = jnp.minimum(d, near + cost)
        return new, jnp.any(new < d)

    return jax.lax.while_loop(lambda carry: carry[1], sweep, (start, jnp.array(True)))[0]
