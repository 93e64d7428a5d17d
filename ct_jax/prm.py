"""Probabilistic roadmaps: the planner that knows the maze (paper, sec. III-A).

A ``Roadmap`` is a ``networkx`` graph with its points as an array and, for use under jit, an all-pairs table of next
hops, so that "where do I go next" is a lookup with thousands of environments on different mazes at once. It is built
over a ``Maze``, or any other ``Space``.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from ct_envs.errors import UserError
from ct_envs.maze import Maze, clearance, in_sight, segment_free, segment_reach, unpadded

_CANDIDATES = 64  # nearest points among which a new waypoint is sought
NO_HOP = -1  # entry of the next-hop table where there is no path


@dataclass(frozen=True)
class PrmConfig:
    """How roadmaps are sampled (paper, sec. III-F)."""

    samples: int = 200  # n
    connect_m: float = 10.0  # d: longest edge [m]
    margin_m: float = 0.0  # clearance kept beyond the robot's radius [m]; the paper keeps none


@struct.dataclass
class PlanTable:
    """A roadmap as arrays, for use under jit. May have leading batch axes."""

    points: Float[Array, "*b n 2"]  # [m]
    next_hop: Int[Array, "*b n n"]  # int16: next_hop[i, j] is the point after i on a shortest path to j
    distance: Float[Array, "*b n n"]  # length of that path [m]; inf where there is none


@dataclass(frozen=True)
class Path:
    """A shortest path: points [k, 2] from start to goal [m] and its length [m]."""

    points: np.ndarray
    length_m: float


@dataclass(frozen=True)
class NoPath:
    """The answer for a pair that the roadmap does not connect."""

    start: tuple[float, float]
    goal: tuple[float, float]
    reason: str

    def __str__(self) -> str:
        start, goal = (f"({x:.2f}, {y:.2f})" for x, y in (self.start, self.goal))
        return f"no path from {start} to {goal}: {self.reason}"


class Space(Protocol):
    """What a roadmap asks of a world, in NumPy: ``ct_envs.turtlebot3_world.World``, or a maze as ``MazeSpace``."""

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Distance [k] (m) from points [k, 2] (m) to the nearest obstacle."""
        ...

    def segment_free(self, ends: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Whether discs of ``radius`` [k] (m) swept along segments, by their ``ends`` [k, 2, 2] (m), touch nothing."""
        ...

    def sample_free(self, rng: np.random.Generator, n: int, radius: float) -> np.ndarray:
        """n points [n, 2] (m), uniform over the area with clearance ``radius`` [m]."""
        ...


@dataclass(frozen=True)
class Roadmap:
    """A graph over collision-free points. Nodes are 0 ... n-1."""

    points: np.ndarray  # float32 [n, 2], [m]
    edges: np.ndarray  # int32 [m, 2], each once, first < second
    maze: Maze | Space
    radius_m: float  # of the robot; every edge keeps it clear, and edges between samples the margin too
    config: PrmConfig

    @property
    def length(self) -> np.ndarray:
        """Lengths float32 [m] of the edges (m)."""
        return np.linalg.norm(self.points[self.edges[:, 0]] - self.points[self.edges[:, 1]], axis=1)

    @functools.cached_property
    def graph(self) -> nx.Graph:
        """The roadmap for networkx; edges carry their length as ``weight`` [m]."""
        graph = nx.Graph()
        graph.add_nodes_from(range(len(self.points)))
        graph.add_weighted_edges_from(zip(*self.edges.T.tolist(), self.length.tolist(), strict=True))
        return graph

    @functools.cached_property
    def _weights(self) -> csr_array:
        """Lengths of the edges, each in both directions: for csgraph, a directed graph (half the work of its other)."""
        both = np.concatenate([self.edges, self.edges[:, ::-1]])
        return csr_array((np.tile(self.length, 2), (both[:, 0], both[:, 1])), shape=(len(self.points),) * 2)

    @functools.cached_property
    def table(self) -> PlanTable:
        """Next hops and distances between all pairs of points."""
        n = len(self.points)
        distance, predecessor = dijkstra(self._weights, return_predecessors=True)
        # The point before i on a path from j is, the graph being undirected, the one after i on the way to j.
        next_hop = np.where(predecessor.T < 0, NO_HOP, predecessor.T).astype(np.int16)
        np.fill_diagonal(next_hop, np.arange(n))
        return PlanTable(jnp.asarray(self.points), jnp.asarray(next_hop), jnp.asarray(distance, jnp.float32))

    def plan(self, start: np.ndarray, goal: np.ndarray) -> Path | NoPath:
        """Shortest path between any two points [m], which are connected to the roadmap as nodes of their own."""
        ends = np.asarray([start, goal], np.float32)
        for name, room in zip(("start", "goal"), as_space(self.maze).clearance(ends), strict=True):
            if not room >= self.radius_m:
                return NoPath(tuple(ends[0]), tuple(ends[1]), f"the {name} is inside a wall or touches one")
        grown = extend(self, ends)
        first, last = len(self.points), len(self.points) + 1
        distance, before = dijkstra(grown._weights, indices=first, return_predecessors=True)
        if not np.isfinite(distance[last]):
            return NoPath(tuple(ends[0]), tuple(ends[1]), "no chain of free roadmap edges joins them")
        nodes = [last]
        while nodes[-1] != first:
            nodes.append(before[nodes[-1]])
        points = grown.points[nodes[::-1]]
        return Path(points, float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()))


def build_roadmap(key: jax.Array, maze: Maze | Space, *, radius_m: float, config: PrmConfig | None = None) -> Roadmap:
    """Sample a roadmap: points uniform over the collision-free area, edges wherever the swept robot stays free.

    Args:
        key: the only source of randomness.
        radius_m: of the robot [m]; ``config.margin_m`` is added to it.

    Raises:
        UserError: the maze or world is too narrow for the robot.
    """
    config = config or PrmConfig()
    radius = radius_m + config.margin_m
    seed = np.asarray(jax.random.key_data(key)).astype(np.uint32)
    rng = np.random.default_rng(seed)
    points = as_space(maze).sample_free(rng, config.samples, radius).astype(np.float32)
    nothing = Roadmap(points[:0], np.zeros((0, 2), np.int32), maze, radius_m, config)
    return extend(nothing, points)


def extend(roadmap: Roadmap, points: np.ndarray) -> Roadmap:
    """The roadmap with further points [k, 2] (m), appended in order and connected wherever the bare robot fits."""
    known = len(roadmap.points)
    points = np.concatenate([roadmap.points, np.asarray(points, np.float32)])
    pairs = _new_pairs(points, known, roadmap.config.connect_m)
    # Between samples the margin is kept; to given points only the radius.
    clear = np.full(len(pairs), roadmap.radius_m, np.float32)
    if roadmap.config.margin_m:
        clear += np.float32(roadmap.config.margin_m) * (pairs[:, 1] < roadmap.config.samples)
    free = as_space(roadmap.maze).segment_free(points.take(pairs, 0), clear)
    return replace(roadmap, points=points, edges=np.concatenate([roadmap.edges, pairs.take(np.flatnonzero(free), 0)]))


def _new_pairs(points: np.ndarray, known: int, reach_m: float) -> np.ndarray:
    """Pairs int32 [k, 2] of points at most ``reach_m`` [m] apart, first < second, the second not among the known."""
    tree = cKDTree(points)
    if not known:
        return tree.query_pairs(reach_m, output_type="ndarray").astype(np.int32)
    near = tree.query_ball_point(points[known:], reach_m)
    second = np.repeat(np.arange(known, len(points)), [len(each) for each in near])
    pairs = np.stack([np.concatenate([*near, []]), second], 1).astype(np.int32)
    return pairs[pairs[:, 0] < pairs[:, 1]]


def as_space(maze: Maze | Space) -> Space:
    """The maze, or what is a space already, as a space."""
    return MazeSpace(maze) if isinstance(maze, Maze) else maze


@dataclass(frozen=True)
class MazeSpace:
    """A maze's compiled queries, in NumPy."""

    maze: Maze

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """As ``Space`` says; at most one cell."""
        return np.asarray(_clearances(self.maze, jnp.asarray(points, jnp.float32)))

    def segment_free(self, ends: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """As ``Space`` says."""
        ends, radius = np.asarray(ends, np.float32), np.asarray(radius, np.float32)
        free, unclear = _in_blocks(functools.partial(_by_cells, self.maze), ends, radius)
        which = np.flatnonzero(unclear)
        ends, radius = ends.take(which, 0), radius.take(which)
        longest = float(np.hypot(*(ends[:, 1] - ends[:, 0]).T).max(initial=0.0))
        reach = segment_reach(longest, float(radius.max(initial=0.0)), float(self.maze.cell_m))
        (free[which],) = _in_blocks(functools.partial(_segments_free, self.maze, reach=reach), ends, radius)
        return free

    def sample_free(self, rng: np.random.Generator, n: int, radius: float) -> np.ndarray:
        """As ``Space`` says. Raises UserError where the cells are too narrow."""
        return _sample_points(rng, self.maze, radius, n)


_BLOCK = 32_768  # most edges that are checked at once: they stay in the processor's cache and share one program


def _in_blocks(check: Callable[..., tuple[jax.Array, ...]], ends: np.ndarray, radius: np.ndarray) -> list[np.ndarray]:
    """What a compiled check says of edges, ends [m, 2, 2] (m) and radii [m] (m): one or more bool [m]."""
    found = []
    for begin in range(0, max(len(ends), 1), _BLOCK):
        block, room = ends[begin : begin + _BLOCK], radius[begin : begin + _BLOCK]
        n = len(block)
        whole = max(1024, 1 << (n - 1).bit_length())  # or three quarters of it: few programs serve all roadmaps
        more = (whole if n > 3 * whole // 4 else 3 * whole // 4) - n
        if more:
            block, room = np.pad(block, ((0, more), (0, 0), (0, 0))), np.pad(room, (0, more))
        found.append([(flag, n) for flag in check(ends=block, radius=room)])
    return [np.concatenate([np.asarray(flag)[:n] for flag, n in flags]) for flags in zip(*found, strict=True)]


@jax.jit
def _by_cells(
    maze: Maze, ends: Float[Array, "m 2 2"], radius: Float[Array, "m"]
) -> tuple[Bool[Array, "m"], Bool[Array, "m"]]:
    """What the cells alone tell of edges: which are free for certain, and which want the exact check.

    An edge is free where the box around it holds no wall, and is not where its middle or a quarter is in one.
    """
    height, width = maze.shape
    counts = jnp.pad(jnp.cumsum(jnp.cumsum(maze.walls, 0), 1), ((1, 0), (1, 0)))  # of walls below and left

    def index(points: Float[Array, "m 2"]) -> tuple[Int[Array, "m"], Int[Array, "m"]]:
        """Cells of points [m]; the border is wall, and so is everything beyond it."""
        row, column = (jnp.floor(points[:, i] / maze.cell_m).astype(jnp.int32) for i in (1, 0))
        return jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)

    a, b = ends[:, 0], ends[:, 1]
    around = radius[:, None] + 1e-4  # more than rounding: never free where the exact check would not be
    (bottom, left), (top, right) = index(jnp.minimum(a, b) - around), index(jnp.maximum(a, b) + around)
    top, right = top + 1, right + 1
    free = counts[top, right] - counts[bottom, right] - counts[top, left] + counts[bottom, left] == 0
    inside = [maze.walls[index(a + share * (b - a))] for share in (0.5, 0.25, 0.75)]
    return free, ~free & ~functools.reduce(jnp.logical_or, inside)


@functools.partial(jax.jit, static_argnames="reach")
def _segments_free(
    maze: Maze, ends: Float[Array, "m 2 2"], radius: Float[Array, "m"], reach: int
) -> tuple[Bool[Array, "m"]]:
    return (jax.vmap(lambda e, r: segment_free(maze, e[0], e[1], radius=r, reach=reach))(ends, radius),)


@jax.jit
def _clearances(maze: Maze, points: Float[Array, "m 2"]) -> jax.Array:
    return jax.vmap(clearance, (None, 0))(maze, points)


def _sample_points(rng: np.random.Generator, maze: Maze, radius: float, n: int) -> np.ndarray:
    """n points uniform over the area with clearance ``radius``, by rejection."""
    cell = float(maze.cell_m)
    free = np.argwhere(~np.asarray(maze.walls))[:, ::-1]
    kept: list[np.ndarray] = []
    count = 0
    for _ in range(50):
        draw = (free[rng.integers(len(free), size=4 * n)] + rng.random((4 * n, 2))) * cell
        good = draw[np.asarray(_clearances(maze, jnp.asarray(draw, jnp.float32))) >= radius]
        kept.append(good.astype(np.float32))
        count += len(good)
        if count >= n:
            return np.concatenate(kept)[:n]
    rows, columns = unpadded(maze).shape
    raise UserError(
        f"maze of {rows} x {columns} cells of {cell} m has no room for a robot of radius {radius} m; use larger cells"
    )


def stack_tables(roadmaps: list[Roadmap]) -> PlanTable:
    """Tables of roadmaps of equal size, stacked along a new leading axis."""
    tables = [roadmap.table for roadmap in roadmaps]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *tables)


@struct.dataclass
class Following:
    """Where N environments are on their plans: their roadmaps, seen from their goals."""

    points: Float[Array, "N n 2"]  # [m]
    next_hop: Int[Array, "N n"]  # towards the goal
    to_go: Float[Array, "N n"]  # way to the goal's point [m]
    waypoint: Int[Array, "N"]
    goal_node: Int[Array, "N"]


@dataclass(frozen=True)
class RoadmapGuide:
    """Gives each environment the next waypoint of its plan (paper, sec. III-A).

    Plans follow the roadmap's shortest path, point after point. With ``shortcut`` the waypoint is instead, at every
    step, the point in sight that makes the shortest way to the goal: smoother, and it recovers from any disturbance.
    """

    radius_m: float  # of the robot
    margin_m: float = 0.0  # clearance beyond the radius on the way to a new waypoint, where its ends have the room [m]
    look_m: float = 10.0  # farthest waypoint that is chosen anew [m]
    cell_m: float = 4.0
    waypoint_tolerance_m: float = 0.5
    shortcut: bool = False

    def init(
        self, tables: PlanTable, which: Int[Array, "N"], maze: Maze, position: jax.Array, goal: jax.Array
    ) -> Following:
        """Connect starts and goals [N, 2] (m) to their roadmaps ``which``; ``maze`` has a leading axis N."""
        points = tables.points[which]
        goal_node = self._nearest_in_sight(points, maze, goal)
        plan = Following(
            points=points,
            next_hop=tables.next_hop[which, :, goal_node].astype(jnp.int32),
            to_go=tables.distance[which, :, goal_node],
            waypoint=goal_node,
            goal_node=goal_node,
        )
        return plan.replace(waypoint=self._choose(plan, maze, position)[0])

    def waypoint(
        self, plan: Following, maze: Maze, position: Float[Array, "N 2"], goal: Float[Array, "N 2"]
    ) -> tuple[Float[Array, "N 2"], Following]:
        """Targets [N, 2] (m), and the plans with reached waypoints passed and lost ones chosen anew."""
        row = jnp.arange(len(plan.waypoint))
        away = jnp.linalg.norm(plan.points[row, plan.waypoint] - position, axis=-1)
        hop = plan.next_hop[row, plan.waypoint]
        waypoint = jnp.where((away < self.waypoint_tolerance_m) & (hop != NO_HOP), hop, plan.waypoint)
        kept = plan.points[row, waypoint]
        # A waypoint is chosen with the margin and kept without it: else a robot beside its path would turn back.
        kept_seen = self._sees(maze, position, kept[:, None], self._keep_m)[:, 0]
        way = jnp.where(kept_seen, jnp.linalg.norm(kept - position, axis=-1) + plan.to_go[row, waypoint], jnp.inf)
        better = jnp.inf if not self.shortcut else 1e-3

        def choose() -> jax.Array:
            new, new_way = self._choose(plan, maze, position)
            return jnp.where(~kept_seen | (new_way < way - better), new, waypoint)

        waypoint = choose() if self.shortcut else jax.lax.cond(jnp.all(kept_seen), lambda: waypoint, choose)
        last = (waypoint == plan.goal_node) & self._sees(maze, position, goal[:, None], self._keep_m)[:, 0]
        target = jnp.where(last[:, None], goal, plan.points[row, waypoint])
        return target, plan.replace(waypoint=waypoint)

    @property
    def _keep_m(self) -> float:
        return 0.8 * self.radius_m

    def _choose(self, plan: Following, maze: Maze, position: jax.Array) -> tuple[Int[Array, "N"], Float[Array, "N"]]:
        """The point in sight that makes the shortest way to the goal, and that way [m].

        Where none is in sight, the nearest point, and infinity.
        """
        away = jnp.linalg.norm(plan.points - position[:, None], axis=-1)
        _, near = jax.lax.top_k(-away, min(_CANDIDATES, away.shape[1]))
        pick = lambda leaf: jnp.take_along_axis(leaf, near, 1)  # noqa: E731
        points = jnp.take_along_axis(plan.points, near[..., None], 1)
        free = self._sees(maze, position, points, self.radius_m + self.margin_m) & (pick(away) <= self.look_m)
        way = jnp.where(free, pick(away) + pick(plan.to_go), jnp.inf)
        best = jnp.argmin(way, -1)[:, None]  # all infinite: the first, which is the nearest
        return jnp.take_along_axis(near, best, 1)[:, 0], jnp.take_along_axis(way, best, 1)[:, 0]

    def _nearest_in_sight(self, points: Float[Array, "N n 2"], maze: Maze, goal: jax.Array) -> Int[Array, "N"]:
        away = jnp.linalg.norm(points - goal[:, None], axis=-1)
        hidden = jnp.where(self._sees(maze, goal, points, self.radius_m), 0.0, 1e6)
        return jnp.argmin(away + hidden, -1).astype(jnp.int32)

    def _sees(self, maze: Maze, position: jax.Array, points: Float[Array, "N n 2"], radius: float) -> jax.Array:
        reach = segment_reach(self.look_m, self.radius_m + self.margin_m, self.cell_m)
        reach = max(reach, segment_reach(1.5 * self.look_m, self.radius_m, self.cell_m))
        sight = functools.partial(in_sight, radius=radius, reach=reach)
        free = jax.vmap(jax.vmap(sight, (None, None, 0)))(maze, position, points)
        return free & (jnp.linalg.norm(points - position[:, None], axis=-1) <= 1.5 * self.look_m)
