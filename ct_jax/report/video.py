"""Videos of episodes in mazes, by MuJoCo's own renderer without a display, as mp4."""

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ct_envs.errors import UserError
from ct_envs.maze import Maze, unpadded
from ct_envs.physics import static_model
from ct_envs.robots import Robot
from ct_jax.progress import Bar

SIZE = 480, 640  # pixels, height and width
MOST_FPS = 25
_LAG_S = 0.4  # of the camera: else a robot that sways shakes the maze
_NEEDS = "a video needs OpenGL without a display (on Debian and Ubuntu: apt install libegl1 libgl1-mesa-dri)"
_TRAIL_EVERY_M, _TRAIL_MOST = 0.4, 400


def check_video(file: Path) -> None:
    """Raises UserError if no video could be written to the file: told before an evaluation, not after it."""
    if file.suffix != ".mp4" or not file.parent.is_dir():
        raise UserError(f"--video {file}: give an .mp4 file in a folder that exists")
    try:
        import av  # noqa: F401  an optional part
    except ImportError:
        raise UserError("--video needs the package av (PyAV): pip install -e '.[video]'") from None
    with _context(8, 8):
        pass


def write_video(
    file: Path, robot: Robot, maze: Maze, qpos: Float[np.ndarray, "T nq"], goal: Float[np.ndarray, "2"], caption: str
) -> None:
    """Film an episode in real time from above and behind: its path is drawn, and the goal as a disc of its tolerance.

    Args:
        qpos: the robot's generalised coordinates before each control step.
        goal: its position [m].
        caption: kept in the file as its title.
    """
    import av

    stride = max(1, round(1 / (MOST_FPS * robot.control_dt_s)))
    frames, frame_s = qpos[::stride], stride * robot.control_dt_s
    with av.open(str(file), "w", options={"movflags": "faststart"}) as container, Bar("video", len(frames)) as bar:
        container.metadata["title"] = caption
        stream = container.add_stream("h264", rate=Fraction(1 / frame_s).limit_denominator(1000))
        stream.height, stream.width = SIZE
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "26"}
        for i, image in enumerate(_images(robot, maze, frames, goal, follow=min(1.0, frame_s / _LAG_S))):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            bar.update(i + 1)
        container.mux(stream.encode(None))


def _images(robot: Robot, maze: Maze, qpos: np.ndarray, goal: np.ndarray, *, follow: float) -> Iterator[np.ndarray]:
    """A picture [height, width, 3] of each pose, of bytes; from one to the next the camera goes that share of the way
    to the robot."""
    model = _scenery(robot, maze)
    data = mujoco.MjData(model)
    height, width = SIZE
    camera, option, scene = mujoco.MjvCamera(), mujoco.MjvOption(), mujoco.MjvScene(model, 2000)
    camera.distance, camera.azimuth, camera.elevation = 2.2 * float(maze.cell_m), 90.0, -50.0
    scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False  # without a GPU they take twice as long as all else
    rect, image = mujoco.MjrRect(0, 0, width, height), np.empty((height, width, 3), np.uint8)
    trail: list[np.ndarray] = []
    looks_at = qpos[0, :2].astype(float)
    with _context(height, width):
        target = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, target)
        try:
            for pose in qpos:
                data.qpos[:] = pose
                mujoco.mj_kinematics(model, data)
                mujoco.mj_camlight(model, data)
                looks_at += follow * (pose[:2] - looks_at)
                camera.lookat[:] = *looks_at, 0.5
                if not trail or np.linalg.norm(pose[:2] - trail[-1]) > _TRAIL_EVERY_M:
                    trail = [*trail, pose[:2].copy()][-_TRAIL_MOST:]
                mujoco.mjv_updateScene(model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
                _mark(scene, goal, robot.goal_tolerance_m, (0.95, 0.72, 0.0, 0.8), mujoco.mjtGeom.mjGEOM_CYLINDER)
                for point in trail:
                    _mark(scene, point, 0.06, (0.11, 0.42, 0.66, 1.0), mujoco.mjtGeom.mjGEOM_SPHERE)
                mujoco.mjr_render(rect, scene, target)
                mujoco.mjr_readPixels(image, None, rect, target)
                yield np.ascontiguousarray(image[::-1])
        finally:
            target.free()


def _scenery(robot: Robot, maze: Maze) -> mujoco.MjModel:
    """The robot in the whole maze, brightly lit."""
    walls = unpadded(maze)
    model = static_model(robot, walls.tobytes(), *walls.shape, cell_m=float(maze.cell_m))
    model.vis.global_.offheight, model.vis.global_.offwidth = SIZE
    model.vis.headlight.ambient[:] = 0.4
    return model


def _mark(scene: mujoco.MjvScene, at: np.ndarray, radius_m: float, rgba: tuple, shape: mujoco.mjtGeom) -> None:
    """Add a ball, or a disc, on the floor."""
    geom = scene.geoms[scene.ngeom]
    size, place = np.array([radius_m, radius_m, 0.02]), np.array([*at, 0.02])
    mujoco.mjv_initGeom(geom, shape, size, place, np.eye(3).ravel(), np.array(rgba, np.float32))
    scene.ngeom += 1


@contextmanager
def _context(height: int, width: int) -> Iterator[None]:
    """OpenGL without a display, whatever MUJOCO_GL says. Raises UserError where there is none."""
    try:
        from mujoco.egl import GLContext  # fails in many ways where a library is missing

        context = GLContext(width, height)
        context.make_current()
    except Exception as error:
        raise UserError(f"{_NEEDS}; here it says: {error or type(error).__name__}") from None
    try:
        yield
    finally:
        context.free()
