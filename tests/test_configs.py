"""A robot of one's own: its MJCF and a file of presets, and nothing else."""

import sys
from dataclasses import replace

import pytest

from ct_envs import UserError, robots
from ct_envs.robots import POINT, model_xml, register
from ct_jax import cli, configs
from ct_jax.cli import main
from ct_jax.configs import find_robot, get_preset
from ct_jax.model import load_model

CONFIG = '''"""A point robot of three times the mass."""

from dataclasses import replace
from pathlib import Path

from ct_envs.robots import POINT, register
from ct_jax.collect import CollectConfig
from ct_jax.controllers.edges import EdgeConfig
from ct_jax.controllers.sac import SacConfig
from ct_jax.fit import FitConfig, ValueConfig
from ct_jax.prm import PrmConfig
from ct_jax.settings import Settings
from ct_jax.transformer import ModelConfig

ROBOT = register(replace(POINT, name="heavy", xml=str(Path(__file__).with_name("heavy.xml")), horizon=50))
FIT = FitConfig(updates=4, batch=4, steps=8, warmup=2)
PRESETS = {
    "tiny": Settings(
        prm=PrmConfig(samples=40, most_samples=40),
        sac=SacConfig(envs=4, iterations=4, updates=1, warmup=2, batch=8, hidden=(8,), replay=200),
        edges=EdgeConfig(episode_steps=5),
        collect=CollectConfig(
            trajectories=2, envs=8, horizon=50, reset_interval=8, starts="maze", guide="explorer", give_up=1000
        ),
        model=ModelConfig(layers=1, heads=2, width=16, context=4, context_acting=4),
        fit=FIT,
        value=ValueConfig(fit=replace(FIT, steps=1), width=16),
        episodes=2,
    )
}
'''


@pytest.fixture
def heavy(tmp_path, monkeypatch):
    """A folder as that of the package's presets, with the files of one more robot."""
    xml = model_xml(POINT)
    assert xml.count('mass="') == 1
    before = xml.partition('mass="')[2].partition('"')[0]
    (tmp_path / "heavy.xml").write_text(xml.replace(f'mass="{before}"', f'mass="{3 * float(before)}"'))
    (tmp_path / "heavy.py").write_text(CONFIG)
    monkeypatch.setattr(configs, "__path__", [*configs.__path__, str(tmp_path)])
    monkeypatch.setattr(robots, "ROBOTS", dict(robots.ROBOTS))
    monkeypatch.setattr(configs, "ROBOTS", robots.ROBOTS)
    yield tmp_path
    sys.modules.pop("ct_jax.configs.heavy", None)
    vars(configs).pop("heavy", None)


@pytest.mark.slow
@pytest.mark.rank_promotion("allow")  # brax's running statistics
def test_a_robot_needs_its_mjcf_and_its_presets_only(heavy, islands, tmp_path, monkeypatch, capsys):
    """It is trained, its model is loaded again, and where names are listed it is among them."""
    monkeypatch.setattr(cli, "prepare_jax", lambda *_: None)
    folder = tmp_path / "run"
    arguments = ["train", "heavy", "--preset", "tiny", "--maze", str(islands), "--eval-maze", str(islands)]
    assert main([*arguments, "--out", str(folder)]) == 0, capsys.readouterr().err
    model = load_model(str(folder))
    assert model.robot == "heavy" and model.settings == get_preset("tiny", "heavy")
    with pytest.raises(UserError, match=r"robots: .*point.*heavy"):
        find_robot("light")


def test_a_name_is_of_one_robot(monkeypatch):
    monkeypatch.setattr(robots, "ROBOTS", dict(robots.ROBOTS))
    assert register(POINT) is POINT
    with pytest.raises(UserError, match="another robot named 'point'"):
        register(replace(POINT, radius_m=0.4))


def test_a_robot_without_presets_is_told_where_they_go(monkeypatch):
    monkeypatch.setattr(robots, "ROBOTS", dict(robots.ROBOTS))
    register(replace(POINT, name="orphan"))
    with pytest.raises(UserError, match=r"no presets for robot 'orphan'; add a file orphan\.py to ct_jax/configs"):
        get_preset("cpu", "orphan")


def test_an_mjcf_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(UserError, match=r"nowhere\.xml: not the MJCF of robot 'lost'"):
        model_xml(replace(POINT, name="lost", xml=str(tmp_path / "nowhere.xml")))
