"""Probabilistic roadmaps: the planner that knows the maze (paper, sec. III-A).

A ``Roadmap`` is a graph over sampled points. For use under jit it gives an all-pairs table of next hops: the next
waypoint of a plan is one lookup, for thousands of environments in different mazes at once. It is built over a ``Maze``
or any other ``Space``.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Annotated, Protocol

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from ct_envs.checked import Above, Checked, Within
from ct_envs.errors import UserError
from ct_envs.maze import Maze, clearance, label_regions, segment_free, segment_reach, unpadded
from ct_jax.runtime.files import whole

_ALL_PAIRS = 2048  # points; the table of a larger roadmap holds the paths to its goals only, to save memory
_JOINED_SHARE = 0.5  # without given ends, a roadmap is complete if it joins this share of the pairs of its own points
_NOWHERE_M = 1e7  # coordinate of padding points: nothing can see them
NO_HOP = -1  # entry of the next-hop table where there is no path


@dataclass(frozen=True)
class PrmConfig(Checked):
    """How roadmaps are sampled (paper, sec. III-G)."""

    samples: Annotated[int, Within(2, 20_000)] = 200  # n; doubled until the roadmap joins starts and goals
    connect_m: Annotated[float, Above(0, 10_000)] = 10.0  # d: longest edge [m]
    margin_m: Annotated[float, Within(0, 100)] = 0.0  # clearance beyond the robot's radius [m]; the paper has none
    # Sampling stops at this number, even if the roadmap does not join everything; a point's index has 16 bits.
    most_samples: Annotated[int, Within(2, 30_000)] = 25_600


@struct.dataclass
class PlanTable:
    """A roadmap as arrays, for use under jit. May have leading batch axes.

    Column j holds the paths to ``points[goal[j]]``. A small roadmap has a column for every point, a large one for some.
    """

    points: Float[Array, "*b n 2"]  # [m]
    goal: Int[Array, "*b m"]
    next_hop: Int[Array, "*b n m"]  # int16: next_hop[i, j] is the point after i on a shortest path to goal[j]
    distance: Float[Array, "*b n m"]  # length of that path [m]; inf where there is none


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
    """What a roadmap needs to know of a world, in NumPy: ``MazeSpace`` or ``ct_envs.turtlebot3_world.World``."""

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Distance [k] (m) from points [k, 2] (m) to the nearest obstacle."""
        ...

    def segment_free(self, ends: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Whether discs of ``radius`` [k] (m), swept along segments with ``ends`` [k, 2, 2] (m), touch nothing."""
        ...

    def sample_free(self, rng: np.random.Generator, n: int, radius: float) -> np.ndarray:
        """n points [n, 2] (m), uniform over the area that has clearance ``radius`` [m]."""
        ...

    def regions(self, points: np.ndarray, radius: float) -> np.ndarray:
        """Free regions, int [k], of points [k, 2] (m), which a robot of ``radius`` [m] can cross; 0 is none."""
        ...


@dataclass(frozen=True)
class Roadmap:
    """A graph over collision-free points. Nodes are 0 ... n-1."""

    points: np.ndarray  # float32 [n, 2], [m]
    edges: np.ndarray  # int32 [m, 2], each once, first < second
    maze: Maze | Space
    radius_m: float  # of the robot; every edge has this clearance, edges between samples also have the margin
    config: PrmConfig
    samples: int  # number of sampled points; they come first, points added later follow

    @property
    def length(self) -> np.ndarray:
        """Lengths float32 [m] of the edges (m)."""
        return np.linalg.norm(self.points[self.edges[:, 0]] - self.points[self.edges[:, 1]], axis=1)

    @functools.cached_property
    def graph(self) -> nx.Graph:
        """The roadmap as a networkx graph. Nodes have ``x_m`` and ``y_m``; edges have a length, ``weight`` [m]."""
        graph = nx.Graph()
        graph.add_nodes_from((i, {"x_m": x, "y_m": y}) for i, (x, y) in enumerate(self.points.tolist()))
        graph.add_weighted_edges_from(zip(*self.edges.T.tolist(), self.length.tolist(), strict=True))
        return graph

    def write_graph(self, file: FilePath) -> None:
        """Write ``graph`` as GraphML, which networkx and graph viewers read. Raises UserError if that fails."""
        with whole(file) as opened:
            nx.write_graphml(self.graph, opened)

    @functools.cached_property
    def _weights(self) -> csr_array:
        """Lengths of the edges, each in both directions: csgraph does half the work on a directed graph."""
        both = np.concatenate([self.edges, self.edges[:, ::-1]])
        return csr_array((np.tile(self.length, 2), (both[:, 0], both[:, 1])), shape=(len(self.points),) * 2)

    @functools.cached_property
    def components(self) -> Int[np.ndarray, "n"]:
        """The connected component of each point."""
        return connected_components(self._weights, directed=False)[1]

    @functools.cached_property
    def table(self) -> PlanTable:
        """Next hops and distances between all pairs of points."""
        return self._table(np.arange(len(self.points)))

    def table_to(self, goals: Int[np.ndarray, "k"]) -> PlanTable:
        """Next hops and distances to the points ``goals``; to all points if the roadmap is small."""
        return self.table if len(self.points) <= _ALL_PAIRS else self._table(np.unique(goals))

    def _table(self, goals: Int[np.ndarray, "m"]) -> PlanTable:
        distance, predecessor = dijkstra(self._weights, indices=goals, return_predecessors=True)
        # The graph is undirected: the point before i on the path from j is also the point after i on the path to j.
        next_hop = np.where(predecessor.T < 0, NO_HOP, predecessor.T).astype(np.int16)
        next_hop[goals, np.arange(len(goals))] = goals
        all_pairs = len(goals) == len(self.points)
        return PlanTable(
            points=jnp.asarray(self.points),
            goal=jnp.asarray(goals, jnp.int32),
            next_hop=jnp.asarray(next_hop),
            distance=jnp.asarray(distance if all_pairs else distance.T, jnp.float32),
        )

    def are_joined(self, pairs: Int[np.ndarray, "k 2"]) -> Bool[np.ndarray, "k"]:
        """Whether there is a path between pairs of points."""
        component = self.components[pairs]
        return component[:, 0] == component[:, 1]

    def distances(self, pairs: Int[np.ndarray, "k 2"]) -> Float[np.ndarray, "k"]:
        """Lengths [m] of the shortest paths between pairs of points; inf where there is none."""
        return dijkstra(self._weights, indices=pairs[:, 0])[np.arange(len(pairs)), pairs[:, 1]].astype(np.float32)

    def plan(self, start: np.ndarray, goal: np.ndarray) -> Path | NoPath:
        """Shortest path between any two points [m]. Both are connected to the roadmap as new nodes."""
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


def build_roadmap(
    key: jax.Array,
    maze: Maze | Space,
    *,
    radius_m: float,
    config: PrmConfig | None = None,
    ends: Float[np.ndarray, "k 2 2"] | None = None,
) -> Roadmap:
    """Sample a roadmap: points uniform over the collision-free area, edges where the swept robot touches nothing.

    The paper samples ``config.samples`` points. A large maze needs more: their number is doubled until the roadmap
    joins each start to its goal. Without ``ends``, it is doubled until the roadmap joins most of its own points.

    Args:
        key: the only source of randomness.
        radius_m: radius of the robot [m]; ``config.margin_m`` is added.
        ends: starts and goals [m]. They do not become points of the roadmap.

    Raises:
        UserError: the maze or world is too narrow for the robot.
    """
    config = config or PrmConfig()
    radius = radius_m + config.margin_m
    seed = np.asarray(jax.random.key_data(key)).astype(np.uint32)
    rng = np.random.default_rng(seed)
    space = as_space(maze)
    roadmap = Roadmap(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.int32), maze, radius_m, config, 0)
    more = config.samples
    while True:
        roadmap = _connect(roadmap, space.sample_free(rng, more, radius).astype(np.float32), sampled=True)
        more = roadmap.samples
        if 2 * more > config.most_samples or _suffices(roadmap, ends):
            return roadmap


def _suffices(roadmap: Roadmap, ends: np.ndarray | None) -> bool:
    """Whether a roadmap joins each start to its goal or, without ``ends``, most of its own points.

    Pairs in different free regions do not count.
    """
    space, radius = as_space(roadmap.maze), roadmap.radius_m + roadmap.config.margin_m
    if ends is None:
        region = space.regions(roadmap.points, radius)
        inside = region > 0
        possible, joined = (int((np.bincount(of[inside]) ** 2).sum()) for of in (region, roadmap.components))
        return joined >= _JOINED_SHARE * possible
    region = space.regions(np.asarray(ends).reshape(-1, 2), radius).reshape(-1, 2)
    together = (region[:, 0] == region[:, 1]) & (region[:, 0] > 0)
    return bool((joins(roadmap, ends) | ~together).all())


def joins(roadmap: Roadmap, ends: Float[np.ndarray, "k 2 2"]) -> Bool[np.ndarray, "k"]:
    """Whether the roadmap has a path from each start to its goal [m]."""
    grown, nodes = extend_by_pairs(roadmap, ends)
    return grown.are_joined(nodes)


def draw_joined(key: jax.Array, roadmap: Roadmap, n: int) -> Int[np.ndarray, "n 2"]:
    """n pairs of different points that the roadmap joins; all such pairs are equally likely.

    Raises:
        UserError: the roadmap joins no two of its points.
    """
    component = roadmap.components
    others = np.bincount(component)[component] - 1  # number of pairs that begin at each point
    ends = np.cumsum(others)
    if not ends[-1]:
        raise UserError("the roadmap joins no two of its points; raise prm.samples or prm.connect_m")
    number = np.asarray(
        jax.random.randint(key, (n,), 0, int(ends[-1]), jnp.int32)
    )  # index of the pair, ordered by first point
    first = np.searchsorted(ends, number, side="right")
    order = np.argsort(component, kind="stable")  # the members of each component, in order
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    begin = np.searchsorted(component[order], component[first])
    skipped = number - (ends - others)[first]
    second = begin + skipped + (skipped >= place[first] - begin)
    return np.stack([first, order[second]], 1)


def extend_by_pairs(roadmap: Roadmap, ends: Float[np.ndarray, "k 2 2"]) -> tuple[Roadmap, Int[np.ndarray, "k 2"]]:
    """The roadmap with starts and goals [m] as points of their own, and the numbers of these points."""
    points = np.asarray(ends).reshape(-1, 2)
    return extend(roadmap, points), len(roadmap.points) + np.arange(len(points)).reshape(-1, 2)


def extend(roadmap: Roadmap, points: np.ndarray) -> Roadmap:
    """The roadmap with more points [k, 2] (m), appended in order. Edges to them keep the radius, not the margin."""
    return _connect(roadmap, points, sampled=False)


def _connect(roadmap: Roadmap, points: np.ndarray, *, sampled: bool) -> Roadmap:
    known = len(roadmap.points)
    points = np.concatenate([roadmap.points, np.asarray(points, np.float32)])
    pairs = _new_pairs(points, known, roadmap.config.connect_m)
    samples = len(points) if sampled else roadmap.samples
    # Edges between samples keep the margin. Edges to given points keep only the radius.
    clear = np.full(len(pairs), roadmap.radius_m, np.float32)
    if roadmap.config.margin_m:
        clear += np.float32(roadmap.config.margin_m) * (pairs[:, 1] < samples)
    free = as_space(roadmap.maze).segment_free(points.take(pairs, 0), clear)
    edges = np.concatenate([roadmap.edges, pairs.take(np.flatnonzero(free), 0)])
    return replace(roadmap, points=points, edges=edges, samples=samples)


def _new_pairs(points: np.ndarray, known: int, reach_m: float) -> np.ndarray:
    """Pairs int32 [k, 2] of points at most ``reach_m`` [m] apart: first < second, and the second is a new point."""
    tree = cKDTree(points)
    if not known:
        return tree.query_pairs(reach_m, output_type="ndarray").astype(np.int32)
    near = tree.query_ball_point(points[known:], reach_m)
    second = np.repeat(np.arange(known, len(points)), [len(each) for each in near])
    pairs = np.stack([np.concatenate([*near, []]), second], 1).astype(np.int32)
    return pairs[pairs[:, 0] < pairs[:, 1]]


def as_space(maze: Maze | Space) -> Space:
    """A maze as a space; a space is returned unchanged."""
    return MazeSpace(maze) if isinstance(maze, Maze) else maze


@dataclass(frozen=True)
class MazeSpace:
    """A maze as a ``Space``: compiled queries with NumPy arrays in and out."""

    maze: Maze

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """See ``Space``; the result is at most one cell."""
        return np.asarray(_clearances(self.maze, jnp.asarray(points, jnp.float32)))

    def segment_free(self, ends: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """See ``Space``."""
        ends, radius = np.asarray(ends, np.float32), np.asarray(radius, np.float32)
        free, unclear = _in_blocks(functools.partial(_by_cells, self.maze), ends, radius)
        which = np.flatnonzero(unclear)
        ends, radius = ends.take(which, 0), radius.take(which)
        longest = float(np.hypot(*(ends[:, 1] - ends[:, 0]).T).max(initial=0.0))
        reach = segment_reach(longest, float(radius.max(initial=0.0)), float(self.maze.cell_m))
        (free[which],) = _in_blocks(functools.partial(_segments_free, self.maze, reach=reach), ends, radius)
        return free

    def sample_free(self, rng: np.random.Generator, n: int, radius: float) -> np.ndarray:
        """See ``Space``. Raises UserError if the cells are too narrow."""
        return _sample_points(rng, self.maze, radius, n)

    def regions(self, points: np.ndarray, radius: float) -> np.ndarray:
        """See ``Space``: regions of 4-connected cells. The radius does not matter: a cell is wider than the robot."""
        del radius
        labels, _ = label_regions(~np.asarray(self.maze.walls))
        column, row = np.floor(np.asarray(points) / float(self.maze.cell_m)).astype(int).T
        return labels[row, column]


_BLOCK = 32_768  # most edges checked in one call: a block fits the processor's cache, and all share one program


def _in_blocks(check: Callable[..., tuple[jax.Array, ...]], ends: np.ndarray, radius: np.ndarray) -> list[np.ndarray]:
    """Run a compiled check on edges with ends [m, 2, 2] (m) and radii [m] (m), block by block: one or more bool [m]."""
    found = []
    for begin in range(0, max(len(ends), 1), _BLOCK):
        block, room = ends[begin : begin + _BLOCK], radius[begin : begin + _BLOCK]
        n = len(block)
        whole = max(1024, 1 << (n - 1).bit_length())  # pad to this or three quarters: few sizes, so few compilations
        more = (whole if n > 3 * whole // 4 else 3 * whole // 4) - n
        if more:
            block, room = np.pad(block, ((0, more), (0, 0), (0, 0))), np.pad(room, (0, more))
        found.append([(flag, n) for flag in check(ends=block, radius=room)])
    return [np.concatenate([np.asarray(flag)[:n] for flag, n in flags]) for flags in zip(*found, strict=True)]


@jax.jit
def _by_cells(
    maze: Maze, ends: Float[Array, "m 2 2"], radius: Float[Array, "m"]
) -> tuple[Bool[Array, "m"], Bool[Array, "m"]]:
    """A fast check of edges by cells: (surely free, undecided). The undecided ones need the exact check.

    An edge is free if the box around it holds no wall. It is blocked if its middle or a quarter point is in a wall.
    """
    height, width = maze.shape
    counts = jnp.pad(jnp.cumsum(jnp.cumsum(maze.walls, 0), 1), ((1, 0), (1, 0)))  # of walls below and left

    def index(points: Float[Array, "m 2"]) -> tuple[Int[Array, "m"], Int[Array, "m"]]:
        """Cells of points [m]. Points outside get a border cell, which is wall."""
        row, column = (jnp.floor(points[:, i] / maze.cell_m).astype(jnp.int32) for i in (1, 0))
        return jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)

    a, b = ends[:, 0], ends[:, 1]
    around = radius[:, None] + 1e-4  # more than the rounding error, so this check is never laxer than the exact one
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
    """n points, uniform over the area that has clearance ``radius``, by rejection sampling."""
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


def stack_tables(tables: list[PlanTable], largest: Callable[[int], int] = int) -> PlanTable:
    """Tables stacked along a new leading axis. Smaller tables are padded with points that nothing can see.

    Args:
        largest: maximum of a number over all processes, so that the tables of all have the same size.
    """
    sizes = np.array([table.next_hop.shape for table in tables])
    n, m = (largest(int(size)) for size in sizes.max(0))
    if (n, m) != tuple(-largest(-int(size)) for size in sizes.min(0)):
        n += 1  # a row for the padding point that padded columns lead to

    def grow(table: PlanTable) -> PlanTable:
        rows, columns = n - table.next_hop.shape[0], m - table.next_hop.shape[1]

        def pad(leaf: jax.Array, more: tuple[int, ...], value: float) -> np.ndarray:
            return np.pad(np.asarray(leaf), [(0, each) for each in more], constant_values=value)

        return PlanTable(
            points=pad(table.points, (rows, 0), _NOWHERE_M),
            goal=pad(table.goal, (columns,), n - 1),
            next_hop=pad(table.next_hop, (rows, columns), NO_HOP),
            distance=pad(table.distance, (rows, columns), np.inf),
        )

    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *map(grow, tables))
