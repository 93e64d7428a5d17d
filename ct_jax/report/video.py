"""Videos of episodes in mazes as mp4 files, drawn by MuJoCo's renderer without a display."""

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from importlib import import_module
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ct_envs.errors import UserError
from ct_envs.maze import Maze, unpadded
from ct_envs.physics import static_spec
from ct_envs.robots import Robot
from ct_jax.runtime.files import check_writable, whole
from ct_jax.runtime.progress import Bar

SIZE = 480, 640  # pixels, height and width
MOST_FPS = 25
_LAG_S = 0.4  # time constant of the camera: it smooths the swaying of the robot
_NEEDS = {  # remedy by the value of MUJOCO_GL, for Debian and Ubuntu
    "egl": "apt install libegl1 libgl1-mesa-dri",
    "osmesa": "apt install libosmesa6, or set MUJOCO_GL=egl",
    "glfw": "glfw needs a display; without one set MUJOCO_GL=egl",
}
_ANY = ("", "enable", "enabled", "on", "true", "1", "glx")  # values of MUJOCO_GL that do not choose a backend
_TRAIL_EVERY_M, _TRAIL_MOST = 0.4, 400


def check_video(file: Path) -> None:
    """Raise UserError if a video cannot be written to the file. Call it before a long evaluation."""
    if file.suffix != ".mp4":
        raise UserError(f"--video {file}: give an .mp4 file")
    check_writable(file, option="--video")
    try:
        import av  # noqa: F401  an optional dependency
    except ImportError:
        raise UserError("--video needs the package av (PyAV): pip install -e '.[video]'") from None
    with _context(8, 8):
        pass


def write_video(
    file: Path, robot: Robot, maze: Maze, qpos: Float[np.ndarray, "T nq"], goal: Float[np.ndarray, "2"], caption: str
) -> None:
    """Film an episode in real time from above and behind. The path and the goal, with its tolerance, are drawn.

    Args:
        qpos: the robot's generalised coordinates before each control step.
        goal: position of the goal [m].
        caption: title in the metadata of the file.
    """
    import av

    stride = max(1, round(1 / (MOST_FPS * robot.control_dt_s)))
    frames, frame_s = qpos[::stride], stride * robot.control_dt_s
    with (
        whole(file) as opened,
        av.open(opened.name, "w", format="mp4", options={"movflags": "faststart"}) as container,
        Bar("video", len(frames)) as bar,
    ):
        container.metadata["title"] = caption
        stream = container.add_stream("h264", rate=Fraction(1 / frame_s).limit_denominator(1000))
        stream.height, stream.width = SIZE
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "26"}
        for i, image in enumerate(_images(robot, maze, frames, goal, follow=min(1.0, frame_s / _LAG_S))):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            bar.update(i + 1)
        container.mux(stream.encode(None))


def _images(robot: Robot, maze: Maze, qpos: np.ndarray, goal: np.ndarray, *, follow: float) -> Iterator[np.ndarray]:
    """A picture of each pose, uint8 [height, width, 3].

    Args:
        follow: share of the distance to the robot that the camera moves from one picture to the next.
    """
    model = _scenery(robot, maze)
    data = mujoco.MjData(model)
    height, width = SIZE
    camera, option, scene = mujoco.MjvCamera(), mujoco.MjvOption(), mujoco.MjvScene(model, 2000)
    camera.distance, camera.azimuth, camera.elevation = 2.2 * float(maze.cell_m), 90.0, -50.0
    scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False  # shadows triple the time without a GPU
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
    """The robot in the whole maze, with more light, and with tiles on the floor that make the motion visible."""
    spec = static_spec(robot, unpadded(maze), float(maze.cell_m))
    spec.add_texture(
        name="tiles", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.60, 0.62, 0.64], rgb2=[0.54, 0.56, 0.58], width=256, height=256,
    )  # fmt: skip
    tiles = spec.add_material(name="tiles", texrepeat=[0.5, 0.5], texuniform=True)  # a tile is 2 m wide
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    floor = spec.geom("floor") or spec.worldbody.add_geom(  # the model of the point has no floor
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 5], contype=0, conaffinity=0
    )
    floor.material, floor.rgba = "tiles", [1, 1, 1, 1]
    model = spec.compile()
    model.vis.global_.offheight, model.vis.global_.offwidth = SIZE
    model.vis.headlight.ambient[:] = 0.4
    return model


def _mark(scene: mujoco.MjvScene, at: np.ndarray, radius_m: float, rgba: tuple, shape: mujoco.mjtGeom) -> None:
    """Add a ball or a disc on the floor."""
    geom = scene.geoms[scene.ngeom]
    size, place = np.array([radius_m, radius_m, 0.02]), np.array([*at, 0.02])
    mujoco.mjv_initGeom(geom, shape, size, place, np.eye(3).ravel(), np.array(rgba, np.float32))
    scene.ngeom += 1


def _backend() -> str:
    """The OpenGL backend: that of MUJOCO_GL, or EGL. Raises UserError if MUJOCO_GL names no backend."""
    given = os.environ.get("MUJOCO_GL", "").lower().strip()
    name = "egl" if given in _ANY else given
    if name not in _NEEDS:
        known = ", ".join(_NEEDS)
        raise UserError(f"MUJOCO_GL='{given}': cannot draw a video; unset it, or give one of: {known}")
    other = os.environ.get("PYOPENGL_PLATFORM", "")
    if name != "glfw" and other and other.lower() != name:
        raise UserError(f"PYOPENGL_PLATFORM='{other}': a video needs it to be {name} here; unset it")
    return name


@contextmanager
def _context(height: int, width: int) -> Iterator[None]:
    """An OpenGL context, without a display unless MUJOCO_GL is glfw. Raises UserError if OpenGL is not available."""
    name = _backend()
    try:
        with warnings.catch_warnings(action="ignore"):  # GLFW warns, and the error says the same
            context = import_module(f"mujoco.{name}").GLContext(width, height)  # raises many kinds of errors
            if not context._context:
                raise RuntimeError("no context was created")
            context.make_current()
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(f"a video needs OpenGL: {_NEEDS[name]} (the error was: {reason})") from None
    try:
        yield
    finally:
        context.free()
