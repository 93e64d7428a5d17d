"""Videos: MuJoCo draws what happened, in real time."""

import sys
from pathlib import Path

import numpy as np
import pytest

from ct_envs import UserError, load_maze
from ct_envs.physics import build_model
from ct_envs.robots import get_robot
from ct_jax.report.video import SIZE, check_video, write_video

av = pytest.importorskip("av")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Where a video can be written, on a machine that can draw one."""
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
    """How many pixels are of the goal's colour."""
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    return int(((red > 200) & (blue < 40) & (green > 150)).sum())


@pytest.mark.parametrize("name", ["point", "ant", "humanoid"])
def test_a_video_lasts_as_long_as_the_episode_and_follows_the_robot_to_its_goal(file: Path, name: str):
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
    assert golden(images[0]) == 0 < golden(images[-1])  # 12 m off it is out of sight
    middle = images[:, SIZE[0] // 3 : -SIZE[0] // 3, SIZE[1] // 3 : -SIZE[1] // 3].astype(int)
    assert np.abs(middle[-1] - middle[0]).max() > 50  # of the robot, at least


def test_what_cannot_be_written_is_told_in_a_line(tmp_path: Path):
    for wrong in (tmp_path / "walk.gif", tmp_path / "nowhere" / "walk.mp4"):
        with pytest.raises(UserError, match=r"give an \.mp4 file in a folder that exists"):
            check_video(wrong)


def test_a_machine_without_opengl_is_told_what_it_lacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    with pytest.raises(UserError, match=r"OpenGL without a display.*libegl1"):
        check_video(tmp_path / "walk.mp4")
