"""Videos: MuJoCo draws episodes in real time."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ct_envs import UserError, load_maze, make_maze
from ct_envs.physics import build_model
from ct_envs.robots import POINT, get_robot
from ct_jax.report.video import SIZE, check_video, write_video

av = pytest.importorskip("av")
POSES = np.linspace([6.0, 6.0], [16.0, 6.0], 40, dtype=np.float32)  # poses of the point


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A file for a video. The test is skipped if the machine has no OpenGL."""
    file = tmp_path / "walk.mp4"
    try:
        check_video(file)
    except UserError as cannot:
        pytest.skip(str(cannot))
    return file


def frames(file: Path) -> np.ndarray:
    with av.open(str(file)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def golden(image: np.ndarray) -> int:
    """The number of pixels with the colour of the goal."""
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    return int(((red > 200) & (blue < 40) & (green > 150)).sum())


@pytest.mark.parametrize("name", ["point", "ant", "humanoid"])
def test_video_has_duration_of_episode_and_follows_robot(file: Path, name: str):
    robot = get_robot(name)
    model = build_model(robot)
    qpos = np.tile(model.key_qpos[0] if model.nkey else model.qpos0, (40, 1)).astype(np.float32)
    qpos[:, 0], qpos[:, 1] = np.linspace(6.0, 16.0, 40), 6.0
    write_video(file, robot, load_maze("antmaze-large"), qpos, np.array([18.0, 6.0]), "a walk")
    images = frames(file)
    with av.open(str(file)) as container:
        seconds, title = container.duration / 1e6, container.metadata["title"]
    assert images.shape[1:] == (*SIZE, 3) and title == "a walk"
    assert seconds == pytest.approx(40 * robot.control_dt_s, rel=0.03)
    assert golden(images[0]) == 0 < golden(images[-1])  # at a distance of 12 m it is out of sight
    middle = images[:, SIZE[0] // 3 : -SIZE[0] // 3, SIZE[1] // 3 : -SIZE[1] // 3].astype(int)
    assert np.abs(middle[-1] - middle[0]).max() > 50  # of the robot, at least


def test_unwritable_video_is_error_of_one_line(tmp_path: Path):
    (tmp_path / "folder.mp4").mkdir()
    wrong = {"walk.gif": r"give an \.mp4 file", "nowhere/walk.mp4": "No such file", "folder.mp4": "Is a directory"}
    for name, said in wrong.items():
        with pytest.raises(UserError, match=f"^--video {tmp_path / name}: .*{said}"):
            check_video(tmp_path / name)


def test_full_disk_leaves_no_partial_video(file: Path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, before[1]))
    try:
        with pytest.raises(UserError, match=rf"^{file}: cannot be written \(File too large\)"):
            write_video(file, POINT, load_maze("antmaze-large"), POSES, np.array([18.0, 6.0]), "a walk")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(file.parent.iterdir()) == []


@pytest.mark.parametrize("name", ["point", "ant", "humanoid"])
def test_floor_is_visible(file: Path, name: str):
    """In a large room, the lower edge of the picture shows only the floor."""
    robot = get_robot(name)
    model = build_model(robot)
    qpos = np.tile(model.key_qpos[0] if model.nkey else model.qpos0, (2, 1)).astype(np.float32)
    qpos[:, :2] = 30.0
    walls = np.pad(np.zeros((13, 13), bool), 1, constant_values=True)
    write_video(file, robot, make_maze(walls), qpos, np.array([32.0, 40.0]), "a stand")
    below = frames(file)[0][-40:].astype(int)
    assert below.min() > 60 and below.max() < 240 and below.std() > 1


# ---------------------------------------------------------------------------------------------------------- OpenGL


def test_missing_opengl_is_error_with_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name, said in (("", "libegl1"), ("egl", "libegl1"), ("osmesa", "libosmesa6"), ("glfw", "needs a display")):
        monkeypatch.setenv("MUJOCO_GL", name)
        monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
        monkeypatch.setitem(sys.modules, f"mujoco.{name or 'egl'}", None)
        with pytest.raises(UserError, match=f"a video needs OpenGL: .*{said}") as told:
            check_video(tmp_path / "walk.mp4")
        assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        ({"MUJOCO_GL": "nonsense"}, "MUJOCO_GL='nonsense': .*egl, osmesa, glfw"),
        ({"MUJOCO_GL": "off"}, "MUJOCO_GL='off': .*unset it"),
        ({"MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "egl"}, "PYOPENGL_PLATFORM='egl': .*to be osmesa here; unset it"),
        ({"PYOPENGL_PLATFORM": "nonsense"}, "PYOPENGL_PLATFORM='nonsense': .*to be egl here; unset it"),
    ],
)
def test_invalid_opengl_variables_are_error(tmp_path: Path, monkeypatch, variables: dict, said: str):
    for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(UserError, match=said):
        check_video(tmp_path / "walk.mp4")


@pytest.mark.parametrize("name", ["egl", "osmesa"])
def test_named_opengl_backend_is_used(file: Path, monkeypatch, name: str):
    """In a separate process, because OpenGL is loaded once. If the backend is not installed, there is an error."""
    monkeypatch.setenv("MUJOCO_GL", name)
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    code = f"""
import sys, pathlib, ct_envs.quiet
from ct_envs import UserError
from ct_jax.report.video import check_video
try:
    check_video(pathlib.Path({str(file)!r}))
    print(*sorted(name for name in sys.modules if name in ("mujoco.egl", "mujoco.osmesa")))
except UserError as bad:
    print("mujoco.{name}" if "needs OpenGL" in str(bad) else bad)
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.stdout == f"mujoco.{name}\n", done.stderr
