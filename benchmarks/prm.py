"""Roadmaps in ``antmaze-large`` (connect distance 10 m): building, the next-hop table, and plans between two points.

    python benchmarks/prm.py [--full]

There are two peers on the same maze. *Python loop* builds the same roadmap with networkx and plain loops over pairs of
points, over the wall cells near them, and over the goals of the table. *OMPL* is OMPL's PRM (the PyPI package) with the
same number of samples, the same average number of neighbours, and a Python function that checks states. It checks its
edges every 0.1 m, whereas ours are checked exactly, and it has no table. Several roadmaps are built in a row, as in a
collection.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import networkx as nx
import numpy as np
from _harness import Contestant, Options, Results, command_line, has_peer

from ct_envs import load_maze
from ct_envs.maze import Maze
from ct_jax.prm import PrmConfig, Roadmap, as_space, build_roadmap

RADIUS_M = 0.5
LOOP = "Python loop"
OMPL = "OMPL"


@dataclass(frozen=True)
class PrmOptions(Options):
    """Sizes of the benchmark."""

    samples: tuple[int, ...] = (100, 200, 1000, 5000)
    """Numbers of points of the roadmaps."""
    table_up_to: int = 1000
    """Maximum number of points for the table (--full: no maximum)."""
    loop_up_to: int = 1000
    """Maximum number of points for the Python loop (--full: no maximum)."""
    loop_table_up_to: int = 200
    """Maximum number of points for the table of the Python loop (--full: 1000)."""
    ompl_up_to: int = 1000
    """Maximum number of points for OMPL (--full: no maximum)."""


def main(options: PrmOptions) -> None:
    """Run the benchmark."""
    results = Results(__file__, options)
    maze = load_maze("antmaze-large")
    ompl = has_peer("ompl", OMPL)
    for samples in options.samples:
        measure(maze, samples, ompl and (options.full or samples <= options.ompl_up_to), options, results)
    growth(maze, options, results)
    results.finish()


def building(maze: Maze, samples: int) -> Callable[[], Roadmap]:
    """A function that builds a new random roadmap at each call."""
    seeds = iter(range(10**6))
    config = PrmConfig(samples=samples)
    return lambda: build_roadmap(jax.random.key(next(seeds)), maze, radius_m=RADIUS_M, config=config)


def _times(n: int, build: Callable[[], object]) -> Callable[[], list[object]]:
    """A function that builds n times."""
    return lambda: [build() for _ in range(n)]


def measure(maze: Maze, samples: int, ompl: bool, options: PrmOptions, results: Results) -> None:
    """The rows of one size."""
    build = building(maze, samples)
    roadmap = build()
    walls, points = np.asarray(maze.walls).tolist(), roadmap.points.tolist()
    cell, reach = float(maze.cell_m), roadmap.config.connect_m
    looped = options.full or samples <= options.loop_up_to
    ours, theirs = max(1, 10_000 // samples), max(1, 2000 // samples)  # in a row
    looping = Contestant(_times(theirs, lambda: loop_roadmap(points, walls, cell, reach)), theirs, compiles=False)
    loop = {LOOP: looping} if looped else {}
    planner = OmplPlanner(maze, max(1, round(2 * len(roadmap.edges) / samples))) if ompl else None
    fast = {OMPL: Contestant(_times(theirs, lambda: planner.build(samples)), theirs, compiles=False)} if planner else {}
    asked = {OMPL: 2.0} if samples == 1000 else {}
    one = Contestant(_times(ours, lambda: build().edges), ours)
    results.race(f"{samples} samples: build", "ms", one, fast, asked=asked)
    if loop:
        asked = {LOOP: 50.0} if samples == 1000 else {}
        results.race(f"{samples} samples: build", "ms", one, loop, asked=asked)
    if options.full or samples <= options.table_up_to:
        tabled = samples <= (1000 if options.full else options.loop_table_up_to)
        graph = roadmap.graph
        by_loop = lambda: (loop_roadmap(points, walls, cell, reach), loop_table(graph))  # noqa: E731
        both = {LOOP: Contestant(by_loop, compiles=False)}
        name = f"{samples} samples: build and table"
        results.race(name, "ms", Contestant(lambda: build().table), both if tabled else {})
    query(maze, samples, roadmap, planner, results)


def query(maze: Maze, samples: int, roadmap: Roadmap, planner: "OmplPlanner | None", results: Results) -> None:
    """The row of plans between points that are not in the roadmap."""
    ends = building(maze, 100)().points
    pairs = list(zip(ends[::2], ends[1::2], strict=True))[: 10 if samples <= 1000 else 3]
    walls, cell, reach = np.asarray(maze.walls).tolist(), float(maze.cell_m), roadmap.config.connect_m
    graph, points = roadmap.graph.copy(), roadmap.points.tolist()
    others = {
        LOOP: Contestant(lambda: [loop_plan(graph, points, walls, cell, reach, *pair) for pair in pairs], len(pairs))
    }
    if planner is not None:
        planner.build(samples)
        others[OMPL] = Contestant(lambda: [planner.plan(*pair) for pair in pairs], len(pairs))
    ours = Contestant(lambda: [roadmap.plan(*pair) and None for pair in pairs], len(pairs))
    results.race(f"{samples} samples: a plan", "ms", ours, others)


def growth(maze: Maze, options: PrmOptions, results: Results) -> None:
    """The row of the growth of the time per edge with the size of the roadmap."""
    small, large = 200, max(options.samples)
    builds = [building(maze, small), building(maze, large)]
    edges = [float(np.mean([len(build().edges) for _ in range(3)])) for build in builds]
    few, many = (Contestant(lambda b=build: b().edges, n) for build, n in zip(builds, edges, strict=True))
    name = f"growth: an edge at {large} samples"
    results.race(name, "µs", many, {f"an edge at {small}": few}, asked={f"an edge at {small}": 1 / 1.3})


# ------------------------------------------------------------------------------------------------- the Python loop


def loop_free(a: list[float], b: list[float], walls: list[list[bool]], cell: float, radius: float) -> bool:
    """Whether a disc swept from a to b touches no wall cell."""
    low = [math.floor((min(a[i], b[i]) - radius) / cell) for i in (0, 1)]
    high = [math.floor((max(a[i], b[i]) + radius) / cell) for i in (0, 1)]
    return all(
        _to_box(a, b, column * cell, row * cell, cell) >= radius
        for row in range(low[1], high[1] + 1)
        for column in range(low[0], high[0] + 1)
        if walls[row][column]
    )


def _to_box(a: list[float], b: list[float], left: float, bottom: float, side: float) -> float:
    """Distance from a segment to a square."""
    enter, leave = 0.0, 1.0
    for start, along, low in ((a[0], b[0] - a[0], left), (a[1], b[1] - a[1], bottom)):
        along = along or 1e-12
        first, second = sorted(((low - start) / along, (low + side - start) / along))
        enter, leave = max(enter, first), min(leave, second)
    if enter <= leave:
        return 0.0
    nearest = math.inf
    for x, y in (a, b):
        nearest = min(nearest, math.hypot(max(left - x, x - left - side, 0.0), max(bottom - y, y - bottom - side, 0.0)))
    dx, dy = b[0] - a[0], b[1] - a[1]
    for x, y in ((left, bottom), (left + side, bottom), (left, bottom + side), (left + side, bottom + side)):
        t = min(max(((x - a[0]) * dx + (y - a[1]) * dy) / (dx * dx + dy * dy or 1e-12), 0.0), 1.0)
        nearest = min(nearest, math.hypot(a[0] + t * dx - x, a[1] + t * dy - y))
    return nearest


def loop_roadmap(points: list[list[float]], walls: list[list[bool]], cell: float, reach: float) -> nx.Graph:
    """The roadmap over the points."""
    graph = nx.Graph()
    graph.add_nodes_from(range(len(points)))
    for j, b in enumerate(points):
        for i, a in enumerate(points[:j]):
            length = math.dist(a, b)
            if length <= reach and loop_free(a, b, walls, cell, RADIUS_M):
                graph.add_edge(i, j, weight=length)
    return graph


def loop_table(graph: nx.Graph) -> dict[int, dict[int, int]]:
    """The next hop from every point (second) to every goal (first)."""
    table = {}
    for goal in graph:
        before, _ = nx.dijkstra_predecessor_and_distance(graph, goal)
        table[goal] = {node: nodes[0] for node, nodes in before.items() if nodes}
    return table


def loop_plan(
    graph: nx.Graph, points: list[list[float]], walls: list[list[bool]], cell: float, reach: float,
    start: np.ndarray, goal: np.ndarray,
) -> list[Any]:  # fmt: skip
    """A shortest path; empty if there is none. Start and goal are added to the roadmap for this query only."""
    graph.add_nodes_from(("start", "goal"))
    others: list[tuple[Any, list[float]]] = list(enumerate(points))
    for name, end in (("start", start.tolist()), ("goal", goal.tolist())):
        for other, point in others:
            length = math.dist(end, point)
            if length <= reach and loop_free(end, point, walls, cell, RADIUS_M):
                graph.add_edge(name, other, weight=length)
        others.append((name, end))
    try:
        path = nx.shortest_path(graph, "start", "goal", weight="weight")
    except nx.NetworkXNoPath:
        path = []
    graph.remove_nodes_from(("start", "goal"))
    return path


# ------------------------------------------------------------------------------------------------------------ OMPL


class OmplPlanner:
    """OMPL's PRM in the maze."""

    def __init__(self, maze: Maze, neighbours: int):
        from ompl import base, geometric, util  # pyright: ignore[reportMissingImports]

        util.setLogLevel(util.LogLevel.LOG_ERROR)
        self._base, self._geometric, self._neighbours = base, geometric, neighbours
        sides = [float(maze.cell_m) * cells for cells in maze.shape[::-1]]
        self._space = base.RealVectorStateSpace(2)
        bounds = base.RealVectorBounds(2)
        for axis, side in enumerate(sides):
            bounds.setLow(axis, 0.0)
            bounds.setHigh(axis, side)
        self._space.setBounds(bounds)
        # A grid of 0.1 m with walls inflated by the robot's radius: the fastest way to check a state in Python.
        x, y = (0.1 * (np.arange(round(10 * side)) + 0.5) for side in sides)
        grid = np.stack(np.meshgrid(x, y), -1)
        clear = as_space(maze).clearance(grid.reshape(-1, 2)).reshape(grid.shape[:2])
        blocked = (clear < RADIUS_M).tolist()
        self._information = base.SpaceInformation(self._space)
        self._information.setStateValidityChecker(lambda state: not blocked[int(10 * state[1])][int(10 * state[0])])
        self._information.setStateValidityCheckingResolution(0.1 / self._space.getMaximumExtent())
        self._information.setup()

    def build(self, samples: int) -> int:
        """Build a roadmap with this number of samples; returns its number of edges."""
        self._prm = self._geometric.PRM(self._information)
        self._prm.setMaxNearestNeighbors(self._neighbours)
        self._prm.setProblemDefinition(self._base.ProblemDefinition(self._information))
        self._prm.setup()
        enough = self._base.PlannerTerminationCondition(lambda: self._prm.milestoneCount() >= samples)
        self._prm.constructRoadmap(enough)
        return self._prm.edgeCount()

    def plan(self, start: np.ndarray, goal: np.ndarray) -> bool:
        """Whether there is a path on the roadmap."""
        problem = self._base.ProblemDefinition(self._information)
        ends = [self._space.allocState() for _ in range(2)]
        for state, point in zip(ends, (start, goal), strict=True):
            state[0], state[1] = map(float, point)
        problem.setStartAndGoalStates(*ends)
        self._prm.clearQuery()
        self._prm.setProblemDefinition(problem)
        return bool(self._prm.solve(self._base.timedPlannerTerminationCondition(1.0)))


if __name__ == "__main__":
    command_line(main, PrmOptions, __doc__)
