"""Two physics engines with the same interface: "mjx" (compiled by XLA) and "mujoco" (C threads behind a callback).

The model contains the robot and ``WALLS`` boxes. Before each control step, the boxes are moved to the wall cells that
the robot can touch in this step. Therefore one compiled program serves all mazes, and the number of contacts is small.
Three boxes are enough: a robot that reaches less than half a cell in a step overlaps at most a 2 x 2 block of cells,
and its own cell is free.

A maze with smaller cells has its walls merged into boxes of any size (``ct_envs.fine``). The model then holds as many
boxes as any place of that maze needs, and their sizes are set before each control step, too.
"""

import functools
import hashlib
import os
import threading
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float
from mujoco import mjx
from mujoco.batch import Batch

from ct_envs import host_call
from ct_envs.errors import UserError
from ct_envs.maze import CELL_M, Boxes, Maze, cell_of, is_wall
from ct_envs.robots import Robot, model_xml

WALLS = 3
WALL_HEIGHT_M = 2.0
_PARKED_M = -1000.0  # height of an unused box
ENGINES = ("auto", "mjx", "mujoco")


@struct.dataclass
class PhysicsState:
    """The state that a step depends on."""

    qpos: Float[Array, "*b nq"]
    qvel: Float[Array, "*b nv"]
    qacc_warmstart: Float[Array, "*b nv"]


class Engine(Protocol):
    """Steps one robot, or many under ``vmap``. A pure function: the same inputs give the same state."""

    name: str
    model: mujoco.MjModel
    n_substeps: int
    cell_m: float
    boxes: int

    def step(self, state: PhysicsState, ctrl: jax.Array, walls: jax.Array) -> tuple[PhysicsState, jax.Array]:
        """One control step under ``ctrl`` [nu] with the walls of ``nearest_walls``.

        Also returns whether any part of the robot touched a wall (0 or 1) in the last substep.
        """
        ...


def build_model(robot: Robot, *, cell_m: float = CELL_M, boxes: int = 0) -> mujoco.MjModel:
    """The robot's model with ``WALLS`` movable wall boxes of one cell, or with so many boxes of any size.

    Raises:
        UserError: the cells are so small that three boxes are not enough.
    """
    if not boxes and robot.reach_m > cell_m / 2:
        raise UserError(
            f"cells of {cell_m} m are too small for robot '{robot.name}'; give a maze of ct_envs.fine.fit_maze, "
            f"or cells of at least {np.ceil(20 * robot.reach_m) / 10:.1f} m"
        )
    spec = mujoco.MjSpec.from_string(model_xml(robot))
    # MuJoCo derives bounding boxes from the size that a box has here, so it is the largest one.
    side_m = 2 * window_m(robot) if boxes else cell_m
    for i in range(boxes or WALLS):
        body = spec.worldbody.add_body(name=f"wall{i}", mocap=True, pos=[0, 0, _PARKED_M])
        add_wall(body, side_m, name=f"wall{i}")
        sensor = spec.add_sensor(type=mujoco.mjtSensor.mjSENS_CONTACT)
        sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_GEOM, f"wall{i}"
        sensor.intprm = [1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1]
    return spec.compile()


def add_wall(body: mujoco.MjsBody, cell_m: float, *, name: str = "") -> None:
    """Give a body the shape of a wall cell."""
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[cell_m / 2, cell_m / 2, WALL_HEIGHT_M / 2],
        contype=0,
        conaffinity=1,
        condim=1,
        solref=[0.04, 1.0],
        rgba=[0.55, 0.6, 0.65, 1.0],
    )


def window_m(robot: Robot) -> float:
    """Walls farther from a robot than this, along an axis, are not built [m]."""
    return 2 * robot.reach_m


def nearest_walls(maze: Maze, position: Float[Array, "2"]) -> Float[Array, "WALLS 3"] | Float[Array, "B 5"]:
    """Centres [m] of the wall cells a robot at ``position`` could touch in a step; boxes not needed are parked.

    With ``maze.boxes``: the centres of boxes of any size, and half their sides along x and y [m].
    """
    if maze.boxes is not None:
        return _near_boxes(maze.boxes, position)
    cell = cell_of(maze, position)
    inside = position[::-1] / maze.cell_m - cell
    row, column = jnp.where(inside >= 0.5, 1, -1)
    zero = jnp.zeros_like(row)
    cells = cell[None] + jnp.array([[row, zero], [zero, column], [row, column]])
    centre = (cells[:, ::-1] + 0.5) * maze.cell_m
    height = jnp.where(is_wall(maze, cells), WALL_HEIGHT_M / 2, _PARKED_M)
    return jnp.concatenate([centre, height[:, None]], -1)


def _near_boxes(boxes: Boxes, position: Float[Array, "2"]) -> Float[Array, "B 5"]:
    """``nearest_walls`` of a maze with boxes."""
    height, width, _ = boxes.near.shape
    column, row = jnp.floor(position / boxes.tile_m).astype(jnp.int32)
    near = boxes.near[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
    sides = boxes.sides[near]
    low = jnp.maximum(sides[:, :2], position - boxes.window_m)
    high = jnp.minimum(sides[:, 2:], position + boxes.window_m)
    there = (near < len(boxes.sides) - 1) & jnp.all(low < high, -1)
    centre = jnp.where(there[:, None], (low + high) / 2, 0.0)
    half = jnp.where(there[:, None], (high - low) / 2, boxes.window_m)
    height_m = jnp.where(there, WALL_HEIGHT_M / 2, _PARKED_M)
    return jnp.concatenate([centre, height_m[:, None], half], -1)


def check_engine(name: str) -> None:
    """Raise UserError with the valid names if the engine is unknown."""
    if name not in ENGINES:
        raise UserError(f"no engine named '{name}'; engines: {', '.join(ENGINES)}")


def make_engine(name: str, robot: Robot, *, cell_m: float = CELL_M, boxes: int = 0) -> Engine:
    """The engine of that name; "auto" is "mujoco" on CPU and "mjx" on accelerators. Raises UserError.

    Args:
        boxes: that a robot may have near it in a maze with ``Maze.boxes``; 0 for mazes without.
    """
    check_engine(name)
    if name == "auto":
        name = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    model = build_model(robot, cell_m=cell_m, boxes=boxes)
    substeps = round(robot.control_dt_s / model.opt.timestep)
    return {"mjx": MjxEngine, "mujoco": MujocoEngine}[name](model, substeps, cell_m, boxes)


class MjxEngine:
    """Physics inside the compiled program, on any XLA device."""

    name = "mjx"

    def __init__(self, model: mujoco.MjModel, n_substeps: int, cell_m: float, boxes: int = 0):
        self.model, self.n_substeps, self.cell_m, self.boxes = model, n_substeps, cell_m, boxes
        with jax.enable_x64(False):
            self._mjx_model = mjx.put_model(model)

    def step(self, state: PhysicsState, ctrl: jax.Array, walls: jax.Array) -> tuple[PhysicsState, jax.Array]:
        with jax.enable_x64(False):  # with 64 bits enabled, MJX mixes 32 and 64 bits
            model = self._mjx_model
            if self.boxes:
                sizes = jnp.asarray(model.geom_size).at[_first_wall(self.model) :, :2].set(walls[:, 3:])
                model = model.replace(geom_size=sizes)
            data = mjx.make_data(model).replace(
                qpos=state.qpos,
                qvel=state.qvel,
                qacc_warmstart=state.qacc_warmstart,
                mocap_pos=walls[:, :3],
                ctrl=ctrl,
            )
            data, _ = jax.lax.scan(lambda d, _: (mjx.step(model, d), None), data, length=self.n_substeps)
            touching = jnp.any(data.sensordata > 0).astype(jnp.float32)
        return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), touching


class MujocoEngine:
    """Physics in MuJoCo's C threads. On a CPU it is about forty times as fast as MJX."""

    name = "mujoco"

    def __init__(self, model: mujoco.MjModel, n_substeps: int, cell_m: float, boxes: int = 0):
        self.model, self.n_substeps, self.cell_m, self.boxes = model, n_substeps, cell_m, boxes
        self._batches: dict[int, tuple[Batch, list[np.ndarray], np.ndarray]] = {}
        self._sizes: dict[int, np.ndarray] = {}  # of the wall boxes of a batch
        self._lock = threading.Lock()  # a Batch serves one caller at a time
        self._name = f"ct_envs_mujoco_{_digest(model, n_substeps)}"
        host_call.register(self._name, lambda inputs, after: np.copyto(after, self._step(inputs)))

    def step(self, state: PhysicsState, ctrl: jax.Array, walls: jax.Array) -> tuple[PhysicsState, jax.Array]:
        # Use one array in each direction: each further array costs as much time as the physics of several robots.
        walls = walls.ravel() if not self.boxes else jnp.concatenate([walls[:, :3].ravel(), walls[:, 3:].ravel()])
        inputs = jnp.concatenate([state.qpos, state.qvel, state.qacc_warmstart, ctrl, walls])
        nq, nv = self.model.nq, self.model.nv
        shape = jax.ShapeDtypeStruct((nq + 2 * nv + self.model.nmocap,), inputs.dtype)
        options: Any = {"vmap_method": "broadcast_all"}
        after = jax.lax.platform_dependent(
            inputs,
            cpu=jax.ffi.ffi_call(self._name, shape, **options),
            default=lambda inputs: jax.pure_callback(self._step, shape, inputs, **options),
        )
        qpos, qvel, warmstart, found = jnp.split(after, [nq, nq + nv, nq + 2 * nv])
        return PhysicsState(qpos, qvel, warmstart), jnp.any(found > 0).astype(jnp.float32)

    def _step(self, inputs: np.ndarray) -> np.ndarray:
        """Step a batch of states [*b, n]. NumPy only, because JAX must not be called in a callback."""
        inputs = np.asarray(inputs)
        rows = inputs.reshape(-1, inputs.shape[-1])
        with self._lock:
            batch, views, found = self._batch(len(rows))
            begin = 0
            for view in views:  # in the order of ``inputs``
                view[:] = rows[:, begin : begin + view.shape[1]]
                begin += view.shape[1]
            if self.boxes:
                self._sizes[len(rows)][:] = rows[:, begin:].reshape(len(rows), self.boxes, 2)
            batch.step(nstep=self.n_substeps)
            after = np.concatenate([*views[:3], found], 1, dtype=inputs.dtype, casting="same_kind")
        return after.reshape(*inputs.shape[:-1], -1)

    def _batch(self, n: int) -> tuple[Batch, list[np.ndarray], np.ndarray]:
        """n simulations, with views [n, ...] of their inputs and of the contacts at the walls."""
        if n not in self._batches:
            threads = min(n, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
            batch = Batch(self.model, nsim=n, nthread=threads)
            names = ("qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos")
            views = [batch.bind(name) for name in names]
            views[-1] = np.lib.stride_tricks.as_strided(
                views[-1], (n, 3 * self.model.nmocap), (views[-1].strides[0], views[-1].itemsize)
            )
            if self.boxes:
                self._sizes[n] = batch.expand("geom_size")[:, _first_wall(self.model) :, :2]
            self._batches[n] = batch, views, batch.bind("sensordata")
        return self._batches[n]


def _first_wall(model: mujoco.MjModel) -> int:
    """Number of the first wall's geom; the others follow, and are the last."""
    return model.ngeom - model.nmocap


def _digest(model: mujoco.MjModel, n_substeps: int) -> str:
    """A digest of an engine, the same in all processes."""
    image = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, image)
    return hashlib.sha256(image.tobytes() + bytes([n_substeps])).hexdigest()[:16]


@functools.cache
def static_model(robot: Robot, walls: bytes, height: int, width: int, cell_m: float = CELL_M) -> mujoco.MjModel:
    """A model with all walls. It is slow; tests compare the movable boxes with it."""
    return static_spec(robot, np.frombuffer(walls, bool).reshape(height, width), cell_m).compile()


def static_spec(robot: Robot, walls: Bool[np.ndarray, "h w"], cell_m: float) -> mujoco.MjSpec:
    """The specification of a model of the robot in a maze with all walls."""
    spec = mujoco.MjSpec.from_string(model_xml(robot))
    for row, column in np.argwhere(walls):
        body = spec.worldbody.add_body(pos=[(column + 0.5) * cell_m, (row + 0.5) * cell_m, WALL_HEIGHT_M / 2])
        add_wall(body, cell_m)
    return spec
