"""The experiments: their variants, rows that are measured once and kept, and pages that show them."""

import importlib
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

import finetuned
import pages
import study
from controllers import described
from intervals import interval_of_mean, pooled
from plots import minutes
from rows import LISTS, Results, Row, TransferRow, add_results, replace_rows
from study import Study, Variant, choose, digest, load_variants, share, stage_digests
from tables import (
    controllers_table,
    differences,
    finetuned_table,
    maze_tables,
    method_name,
    put,
    reasons,
    room_tables,
    runs_table,
    summary_table,
    transfer_table,
)

from ct_envs import UserError
from ct_envs.robots import get_robot
from ct_jax.baselines.cql import CqlConfig
from ct_jax.baselines.sac_alone import SacAloneConfig
from ct_jax.configs import get_preset
from ct_jax.finetune import NoRecoveryError
from ct_jax.runtime.checkpoint import read_json
from ct_jax.runtime.run import Run, load_mazes
from ct_jax.settings import with_fits

MADE = {"command": "python x.py", "commit": "abc", "hardware": "CPU", "created": "2026-01-01T00:00:00"}
MAZE_ROBOTS = ("point", "ant", "humanoid")

pytestmark = pytest.mark.rank_promotion("allow")  # brax's running statistics


def a_row(variant="cpu", seed=0, method="ct", success="01", **more) -> Row:
    """A row of a model with these outcomes."""
    head = {"variant": variant, "model_seed": seed, "method": method, "robot": "point", "maze": "m", "seen": True}
    head |= {"episodes": len(success), "seed": 0, "outcomes": {"success": success}}
    return Row.read(MADE | head | {"success_rate": success.count("1") / len(success)} | more)


def fits_of(settings):
    """The trainings of a fine-tuned transformer, first to last."""
    return [settings.fit, *[settings.round_fit] * (settings.rounds - 1), settings.last_fit]


# -------------------------------------------------------------------------------------------------------- variants


@pytest.mark.parametrize("robot", study.ROBOTS)
def test_variants_override_existing_settings(robot):
    """Each fine-tuned variant names its variant before fine-tuning, which has the same data and no rounds."""
    variants = load_variants(robot)
    assert variants[sys.modules[robot].SHIPPED].preset == "cpu"
    for name, variant in variants.items():
        settings = variant.settings(robot)
        assert settings == get_preset(variant.preset, robot) or variant.changes, name
        if variant.tuned_from:
            before = variants[variant.tuned_from].settings(robot)
            assert settings.rounds > 0 == before.rounds, name
            assert variant.preset == variants[variant.tuned_from].preset, name
            if settings.rooms == before.rooms:  # the rooms of "dense" differ
                assert settings.collect == before.collect, name


def test_override_of_unknown_setting_is_error():
    for changes in ({"model.nodes": 4}, {"models": 4}, {"rounds.fit": 4}):
        with pytest.raises((TypeError, AttributeError)):
            Variant("cpu", changes).settings("point")


@pytest.mark.parametrize("robot", MAZE_ROBOTS)
def test_variants_match_methods_of_table(robot):
    known = load_variants(robot)
    assert list(known)[:7] == ["published", "bc", "f-ct", "pt-cql", "sac", "cpu-ct", "cpu"]
    assert [name for name, variant in known.items() if variant.baseline] == ["pt-cql", "sac"]
    variants = {name: variant.settings(robot) for name, variant in known.items()}
    for name in ("roam", "modes+roam", "modes+memory+roam"):  # trajectories from one maze, recoveries from many
        tuned, ct = variants[name], variants[known[name].tuned_from or ""]
        assert tuned.recover.random_mazes > 0 == tuned.random_mazes == ct.random_mazes and tuned.collect == ct.collect
    assert all(variants[name] == variants["published"] for name in ("pt-cql", "sac"))  # the same data
    published, bc, fct = (variants[name] for name in ("published", "bc", "f-ct"))
    assert replace(bc, model=published.model) == published and not bc.model.returns
    assert fct.rounds == 1 and fct.recover.keep == "separate" and fct.collect == published.collect
    assert (
        not published.clip_target_return and published.collect.guide == "roadmap" and published.model.frame == "world"
    )
    stuck = {"point": (40, 20), "ant": (80, 40), "humanoid": (120, 60)}
    assert (fct.recover.stuck_steps, fct.recover.bumps) == stuck[robot]
    lifted_ct, lifted = (variants[name] for name in ("cpu-ct", "cpu"))
    assert lifted.last_fit is not None and lifted_ct.fit == replace(lifted.last_fit, shift_timestep=300)
    of_many_ct, of_many = (variants[name] for name in ("mazes-ct", "mazes"))
    assert of_many_ct.random_mazes == of_many.random_mazes > 0
    assert of_many_ct.fit.updates == sum(fit.updates for fit in fits_of(of_many))  # the same number of updates
    for name, one in (("modes-ct", lifted_ct), ("modes", lifted)):  # nothing else differs
        assert replace(variants[name], model=one.model) == one and variants[name].model.modes > 1
    for name, one in (("skill-ct", lifted_ct), ("skill", lifted)):
        found = variants[name] if robot != "humanoid" else one
        assert found == with_fits(replace(one, model=replace(one.model, skill=True)), turns=robot != "point")
    for name, one in (("memory-ct", lifted_ct), ("memory", lifted)):
        assert replace(variants[name], model=one.model) == one and variants[name].model.stride > 1
        assert variants[f"calm+{name}"] == replace(variants[name], controller_action_scale=0.75)
    for name in ("calm-ct", "calm"):
        one, longer = variants[name], variants[name.replace("calm", "calm+long")]
        assert fits_of(longer)[-1 if one.rounds else 0].updates == 2 * fits_of(one)[-1 if one.rounds else 0].updates
        assert replace(longer, fit=one.fit, last_fit=one.last_fit) == one
    assert variants["modes"].model.commitment > variants["modes-ct"].model.commitment == 0.0
    sac = known["sac"].baseline
    assert isinstance(sac, SacAloneConfig) and sac.sac.iterations >= 4 * get_robot(robot).horizon
    assert sac.reward.alive_bonus == 0.0  # of the maze's reward: minus the distance


def test_unknown_variant_is_error():
    known = load_variants("ant")
    assert list(choose(known, "cpu", ("cpu",))) == ["cpu"]
    assert list(choose(known, "cpu", ("cpu", "sac"))) == ["sac", "cpu"]
    with pytest.raises(
        UserError, match="no variant named 'gpu' with preset 'cpu'; variants: published, bc, f-ct, pt-cql"
    ):
        choose(known, "cpu", ("gpu",))
    with pytest.raises(UserError, match="no experiment for robot 'cat'; robots: point, ant"):
        load_variants("cat")


def test_all_presets_have_all_methods_of_paper():
    paper = choose(load_variants("ant"), "paper")
    assert list(paper) == ["published", "bc", "f-ct", "pt-cql", "sac"]
    of_size = [variant.settings("ant", "paper") for variant in paper.values()]
    assert [(settings.model.width, settings.fit.updates) for settings in of_size] == [(512, 75_000)] * 5
    assert of_size[2].round_fit is not None and of_size[2].round_fit.updates == 37_500
    assert list(choose(load_variants("ant"), "demo")) == ["demo"]
    assert list(choose(load_variants("turtlebot3"), "published")) == ["ct", "bc-ct", "f-ct"]


def test_turtlebot3_variants_share_stages():
    variants = {name: variant.settings("turtlebot3") for name, variant in load_variants("turtlebot3").items()}
    assert list(variants)[:4] == ["ct", "bc-ct", "f-ct", "cpu-ct"]
    assert list(variants)[4:] == ["cpu-ct-v", "cpu-ct-actions", "cpu", "noise-ct", "noise", "dense"]
    lifted, seeing = variants["cpu-ct"], variants["cpu-ct-actions"]
    assert variants["cpu-ct-v"] == replace(lifted, return_scale=1.0)
    same = replace(variants["cpu"], rounds=0, return_scale=lifted.return_scale)
    assert replace(same, fit=replace(same.fit, shift_timestep=300)) == lifted and lifted.return_scale < 1.0
    assert replace(seeing, model=lifted.model) == lifted and seeing.model.actions and not lifted.model.actions
    densities = [variants[name].rooms.densities for name in ("cpu", "dense")]  # pyright: ignore
    assert densities == [(1.0, 1.0), (0.5, 2.0)]
    ct, bc, fct = (variants[name] for name in ("ct", "bc-ct", "f-ct"))
    assert replace(fct, rounds=0) == ct and fct.rounds == 1 and fct.recover.keep == "separate"
    assert replace(bc, model=ct.model) == ct and not bc.model.returns
    assert (ct.model.layers, ct.model.heads, ct.model.width, ct.model.context) == (4, 4, 128, 5)
    assert (ct.fit.batch, ct.fit.learning_rate, ct.fit.updates, ct.fit.warmup) == (128, 1e-4, 15_000, 10_000)


# ------------------------------------------------------------------------------------------------------------ runs


@pytest.fixture
def tiny_study(tiny_settings, tmp_path, monkeypatch):
    """A study in which all presets are the tiny one."""
    monkeypatch.setattr(study, "get_preset", lambda name, robot: tiny_settings)
    return Study(robot="point", preset="tiny", out=tmp_path)


def ignore(found: Results) -> None:
    """Ignore the results."""


def test_rows_are_measured_once_and_kept(tiny, tiny_run, tiny_settings, tiny_study, monkeypatch):
    """A finished run is not repeated, and the baselines are trained on its data."""
    shutil.copytree(tiny_run.folder, tiny_study.out / "one-0")
    mazes = ((tiny_run.arguments[tiny_run.arguments.index("--maze") + 1],), ("antmaze-umaze",))
    monkeypatch.setattr(study, "default_mazes", lambda robot: mazes)
    cql = CqlConfig(updates=2, batch=4, width=8, samples=1)
    sac = SacAloneConfig(replace(tiny_settings.sac, iterations=4, warmup=1))
    variants = {
        "one": Variant("tiny"), "pt-cql": Variant("tiny", baseline=cql), "sac": Variant("tiny", baseline=sac),
    }  # fmt: skip
    rows = tiny_study.run(variants, (0,), ignore).rows
    assert [row.method for row in rows] == [*["ct", "planner", "explorer"] * 2, *["pt-cql"] * 2, *["sac"] * 2]
    assert [row.variant for row in rows] == [*["one"] * 6, *["pt-cql"] * 2, *["sac"] * 2]
    assert all(row.episodes == 4 and row.seed == 0 for row in rows)
    assert all(0 < (row.learn_wall_s or 0) <= row.run_wall_s for row in rows if row.method in ("pt-cql", "sac"))
    assert all(set(row.more) >= {"success_ci95", "return_mean"} for row in rows)  # and all other measurements
    monkeypatch.setattr("ct_jax.baselines.cql.train_cql", None)
    assert tiny_study.run(variants, (0,), ignore).rows == rows
    variants["pt-cql"] = Variant("tiny", baseline=replace(cql, updates=3))
    with pytest.raises(UserError, match="other settings; delete it"):
        tiny_study.run(variants, (0,), ignore)


def test_sac_alone_needs_no_controller_and_no_data(tiny_settings, tiny_study, monkeypatch):
    """Its run contains only a policy and rows: no controller and no trajectories."""
    monkeypatch.setattr(study, "default_mazes", lambda robot: (("antmaze-umaze",), ()))
    sac = SacAloneConfig(replace(tiny_settings.sac, iterations=4, warmup=1))
    (row,) = tiny_study.run({"sac": Variant("tiny", baseline=sac)}, (0,), ignore).rows
    assert row.method == "sac" and row.controller is None
    assert not any((tiny_study.out / "sac-0" / stage).exists() for stage in study.STAGES)


def test_references_have_one_row_per_margin(tiny_settings, tiny_study, monkeypatch):
    """A planner with another margin is another reference, and has its own row."""
    margin = tiny_settings.prm.margin_m
    variants = {
        "one": Variant("tiny"), "two": Variant("tiny", {"rounds": 2}), "wary": Variant("tiny", {"prm.margin_m": 0.3}),
    }  # fmt: skip
    monkeypatch.setattr(study.pipeline, "train", lambda run, resume: None)
    monkeypatch.setattr(study, "share", lambda runs, run: None)
    monkeypatch.setattr(study, "outcomes", lambda folder, row: {})
    monkeypatch.setattr(study, "read_json", lambda file: MADE)
    monkeypatch.setattr(study, "controller_digest", lambda where, robot: "abc")
    scores = {"robot": "point", "maze": "m", "episodes": 1, "seed": 0, "success_rate": 1.0}
    monkeypatch.setattr(
        study.pipeline, "results", lambda folder: [{"method": method} | scores for method in ("ct", "planner")]
    )
    rows = tiny_study.run(variants, (0, 1), ignore).rows
    planners = [row for row in rows if row.method == "planner"]
    assert [(row.variant, row.margin_m) for row in planners] == [("one", margin), ("wary", 0.3)]
    assert [method_name(row, variants) for row in planners] == ["planner", "planner, 0.3 m margin"]
    assert len(rows) == 2 * 3 + 2


def test_failed_run_does_not_stop_others(tiny_study, monkeypatch):
    def measure(run, name, variant):
        if name == "one":
            raise UserError("full disk")
        return [a_row(name)]

    monkeypatch.setattr(study, "share", lambda runs, run: None)
    monkeypatch.setattr(study, "measure", measure)
    kept = []
    with pytest.raises(UserError, match="one-0: full disk"):
        tiny_study.run(dict.fromkeys(("one", "two"), Variant("tiny")), (0,), kept.append)
    assert [row.variant for row in kept[-1].rows] == ["two"] and not kept[-1].unmade


def test_missing_recoveries_are_recorded_as_result(tiny_study, tmp_path, monkeypatch):
    """The other runs continue. The reason is in the results and on the page until the row exists."""

    def measure(run, name, variant):
        if name == "f-ct":
            raise NoRecoveryError("no recovery in 9 episodes")
        return [a_row(name)]

    monkeypatch.setattr(study, "share", lambda runs, run: None)
    monkeypatch.setattr(study, "measure", measure)
    monkeypatch.setattr(
        study, "made_of", lambda run, name, method: MADE | {"variant": name, "model_seed": 0, "method": method}
    )
    file = tmp_path / "results.json"
    known = load_variants("point")
    variants = {"f-ct": replace(known["f-ct"], changes={}), "published": replace(known["published"], changes={})}
    tiny_study.run(variants, (0,), lambda found: add_results(file, found))
    found = Results.read(file)
    assert [row.variant for row in found.rows] == ["published"]
    (line,) = reasons(found.unmade, known)[2:]
    assert line.startswith("| F-CT | 0 | no recovery in 9 episodes | `python x.py` | abc |")
    add_results(file, Results(rows=[a_row("f-ct")]))
    assert Results.read(file).unmade == [] and reasons([], known) == []


def test_stages_with_same_inputs_are_shared(tiny_run, tiny_settings, tmp_path):
    def run(name, **changes):
        maze = load_mazes((tiny_run.arguments[tiny_run.arguments.index("--maze") + 1],))
        unseen = load_mazes(("antmaze-umaze",))
        return Run(tmp_path / name, "point", "tiny", replace(tiny_settings, **changes), maze, unseen, 0, "auto")

    source = replace(run("source"), folder=tiny_run.folder)
    others = {
        "rounds": run("rounds", rounds=2),
        "model": run("model", model=replace(tiny_settings.model, returns=False)),
        "collect": run("collect", collect=replace(tiny_settings.collect, noise=0.1)),
        "mazes": run("mazes", random_mazes=2),
        "prm": run("prm", prm=replace(tiny_settings.prm, samples=50)),
        "seed": replace(run("seed"), seed=1),
        "eval": replace(run("eval"), eval_mazes={}),
    }
    taken = {"rounds": 3, "model": 2, "collect": 1, "mazes": 1, "prm": 0, "seed": 0, "eval": 0}
    for name, other in others.items():
        share([source], other)
        stages = [stage for stage in study.STAGES if other.done(stage) is not None]
        assert stages == list(study.STAGES)[: taken[name]], name
        rows = {file.stem.rpartition("-")[2] for file in (other.folder / "evaluate").glob("*.json")}
        assert rows == ({"planner", "explorer"} if taken[name] else set()), name
        assert share([source], other) is None  # a second call changes nothing
    ours = stage_digests(source)
    assert len({*ours.values()}) == len(ours) and stage_digests(source) == ours


def test_digest_depends_on_settings():
    settings = get_preset("cpu")
    assert digest(settings) == digest(get_preset("cpu")) != digest(replace(settings, rounds=1))
    assert digest(settings, CqlConfig()) != digest(settings)


# --------------------------------------------------------------------------------------------------------- results


@pytest.mark.parametrize("file", sorted(Path(study.RESULTS).glob("*-*.json")), ids=lambda file: file.stem)
def test_reading_and_writing_results_is_the_identity(file, tmp_path):
    found = Results.read(file)
    found.write(tmp_path / "again.json")
    before, again = read_json(file), read_json(tmp_path / "again.json")
    assert {name: rows for name, rows in before.items() if rows} == again
    assert found.rows and all(row.more for row in found.rows)


def test_invalid_row_is_error():
    with pytest.raises(UserError, match=r"not a row of results .*'variant'.*; measure it again"):
        Row.read(MADE | {"method": "ct"})


def test_rows_of_other_commands_are_kept(tmp_path):
    file = tmp_path / "new" / "results.json"
    planner = a_row("ct", 0, "planner", "11")
    add_results(file, Results(rows=[a_row("ct", 0), planner], noise=[a_row("ct", 0)]))
    add_results(file, Results(rows=[a_row("ct", 1), a_row("bc", 0), a_row("bc", 0, "planner", "10")]))
    add_results(file, Results(rows=[a_row("ct", 0, success="11")]))
    found = Results.read(file)
    assert [(row.variant, row.model_seed, row.method, row.success_rate) for row in found.rows] == [
        ("ct", 1, "ct", 0.5), ("bc", 0, "ct", 0.5), ("bc", 0, "planner", 0.5), ("ct", 0, "ct", 1.0),
    ]  # fmt: skip
    assert found.noise == [a_row("ct", 0)]
    again = a_row("bc", 0, "planner", "01", margin_m=0.0)  # early rows have no margin
    wary = a_row("cpu", 0, "planner", "11", margin_m=0.3)
    add_results(file, Results(rows=[again, wary]))
    assert [row for row in Results.read(file).rows if row.method == "planner"] == [again, wary]


def test_rows_with_old_settings_are_dropped(tmp_path, capsys):
    """All rows of a changed variant are dropped, so that no table mixes old and new settings."""
    file = tmp_path / "results.json"
    old = [a_row("cpu", seed, settings="old") for seed in (0, 1)]
    stays = [a_row("cpu", 0, "planner", settings="old"), a_row("ct", 0, settings="ct's")]
    add_results(file, Results(rows=[*old, *stays], noise=[old[0]]))
    new = a_row("cpu", 0, settings="new")
    add_results(file, Results(rows=[new]))
    assert Results.read(file) == Results(rows=[*stays, new])
    assert "dropped cpu, seed 1: its settings have changed" in capsys.readouterr().err


def test_rows_with_same_key_are_replaced(tmp_path):
    file = tmp_path / "new" / "finetuned.json"
    replace_rows(file, [a_row("cpu", 0), a_row("cpu", 1)], ("variant", "model_seed"), Row)
    again = a_row("cpu", 0, success="11")
    assert replace_rows(file, [again], ("variant", "model_seed"), Row) == [a_row("cpu", 1), again]


# ---------------------------------------------------------------------------------------------------------- tables


def test_gain_of_fine_tuning_is_computed_per_pair():
    half, known = "01" * 50, load_variants("point")
    before = [a_row("published", 0, success=half), a_row("published", 1, success=half)]
    after = [a_row("f-ct", 1, success="1" * 100), a_row("f-ct", 0, success=half)]
    *_, line = differences(Results(rows=before + after), known)
    assert line.startswith("| m | F-CT − CT | +25.0 (+0.0 to +5") and line.endswith(" | 2 |")
    other = [replace(row, controller="another") for row in after]
    assert differences(Results(rows=before + other), known) == []
    assert interval_of_mean(np.zeros((3, 100))) == (0.0, 0.0)
    low, high = interval_of_mean(np.tile([0.0, 1.0], (3, 50)))
    assert 0.38 < low < 0.42 and 0.58 < high < 0.62  # a binomial interval if the models were equal


def test_interval_is_wider_if_models_differ():
    """The interval is wide for rates of 88, 84 and 78 %, and a Wilson interval for equal models or one model."""

    def width(*rates):
        rows = [a_row(success="1" * round(500 * rate) + "0" * round(500 * (1 - rate))) for rate in rates]
        low, high = re.findall(r"\((\d+) to (\d+)\)", pooled(rows, "success"))[0]
        return int(high) - int(low)

    assert width(0.884, 0.836, 0.78) >= 8
    assert width(0.836) in (6, 7) and width(0.836, 0.836, 0.836) in (6, 7)  # three models with the same outcomes


def test_maze_table_has_variants_in_order_and_references_last():
    rows = [a_row("", 0, "planner"), a_row("cpu", 1, success="1110"), a_row("cpu", 0, success="1100")]
    rows += [a_row("published"), a_row("of-yesterday")]
    lines = maze_tables(Results(rows=rows), load_variants("point"))
    assert lines[0] == "### m (seen)"
    assert [line.split(" | ")[0] for line in lines[4:8]] == [
        "| CT", "| F-CT, `cpu`", "| planner", "| CT, `of-yesterday`",
    ]  # fmt: skip
    assert lines[5].split(" | ")[2] == "50, 75" and lines[6].split(" | ")[2] == ""


def test_page_shows_origin_of_rows():
    rows = [a_row("cpu", 1, run_wall_s=600.0, collect_wall_s=60.0), a_row("cpu", 0, run_wall_s=1200.0)]
    rows += [a_row("cpu", 2, commit="def", run_wall_s=60.0), a_row("cpu", 0, "planner")]
    assert runs_table(rows, load_variants("point"))[2:] == [
        "| `cpu` | 0, 1 | 15 (1.0 for collection) | `python x.py` | abc | CPU | 2026-01-01 |",
        "| `cpu` | 2 | 1 | `python x.py` | def | CPU | 2026-01-01 |",
        "| planner, explorer |  |  | `python x.py` | abc | CPU | 2026-01-01 |",
    ]


def test_turtlebot3_table_joins_models():
    def row(seed, density, success, **more):
        rates = {"success_rate": success, "frontal_rate": 0.0, "grazing_rate": 0.1, "spl": 0.5, "episodes": 500}
        where = {"density": density, "noise": 0.0, "worlds": 20, "pairs": 25}
        return a_row("ct", seed, **rates | where | more)

    rows = [replace(row(seed, 1.0, success), outcomes=None) for seed, success in ((0, 0.9), (1, 1.0))]
    seven = [row(0, 1.0, 0.9, full=60, partial=5, failed=5)]
    lines = room_tables(Results(rows=rows, density=[row(0, 1.5, 0.8)], seven=seven))
    found = [line.split(" | ") for line in lines if line.startswith("| ct")]
    assert [cells[3] for cells in found[:2]] == ["95.0 (93 to 96)", "80.0 (76 to 83)"]
    assert found[0][0] == "| ct, 2 models" and found[0][4] == "90, 100"
    assert found[2][2:] == ["60", "5", "5 |"] and len(found) == 3


def test_gain_table_has_one_line_per_f_ct_and_ct():
    def row(variant, seed, successes):
        return a_row(variant, seed, success=successes, controller="one")

    def table(*rows):
        return [line.split(" | ") for line in finetuned_table(rows, load_variants)[2:]]

    one = [row("cpu", 0, "1111"), row("cpu-ct", 0, "0000")]
    many = [row("mazes-ct", 1, "0011"), row("mazes-ct", 0, "1100"), row("mazes", 0, "1110"), row("mazes", 1, "0110")]
    lines = table(*many, *one)
    assert [line[1:6] for line in lines] == [
        ["`mazes`", "`mazes-ct`", "m", "2", "4"],
        ["`cpu`", "`cpu-ct`", "m", "1", "4"],
    ]
    assert [line[-1].split()[0] for line in lines] == ["+12.5", "+100.0"]
    assert table(*one, *many)[1] == lines[0]  # in any order
    roaming = [row("roam", 0, "1101"), row("roam", 1, "1111")]  # its CT, cpu-ct, has no seed 1
    (line,) = (line for line in table(*one, *roaming) if line[1] == "`roam`")
    assert line[4] == "1" and line[-1].startswith("+75.0")
    (line,) = (line for line in table(*one, *roaming, row("long-ct", 1, "0111")) if line[2] == "`long-ct`")
    assert line[1] == "`roam`" and line[4] == "1" and line[-1].startswith("+25.0")


def test_only_fine_tuned_variants_are_compared():
    assert finetuned.before_of(finetuned.Options(robot="ant", tuned="skill")) == "skill-ct"
    assert finetuned.before_of(finetuned.Options(tuned="roam", longer=True)) == "long-ct"
    with pytest.raises(UserError, match="--tuned cpu-ct: not a fine-tuned variant; give one of f-ct, cpu, mazes"):
        finetuned.before_of(finetuned.Options(tuned="cpu-ct"))


def test_transfer_table_interpolates_updates():
    curves = {("scratch", 0): (0.0, 0.2, 0.8), ("scratch", 1): (0.0, 0.4, 1.0), ("ant", 0): (0.5, 0.85, 0.9)}
    head = MADE | {"robot": "point", "run": "cpu-0", "maze": "m", "episodes": 100}
    rows = [
        TransferRow.read(
            head | {"start": start, "source": None if start == "scratch" else "cpu-0"}
            | {"seed": seed, "updates": mark, "success_rate": rate}
        )
        for (start, seed), curve in curves.items()
        for mark, rate in zip((25, 50, 100), curve, strict=True)
    ]  # fmt: skip
    lines = transfer_table(rows)
    # 51 of 60 percentage points between 50 and 100 updates
    assert lines[2] == "| point | `cpu-0` | from scratch | 2 | 0 | 30 | 90 | 90 |"
    assert lines[3] == "| point | `cpu-0` | from the trunk of the ant's cpu-0 | 1 | 50 | 85 | 90 | 46 |"


def test_shipped_controller_has_learning_curve(tiny_run):
    found = described(tiny_run.folder)
    curve, config = found["made"]["curve"], found["sac"]
    assert curve and curve[-1] == (config["iterations"], found["made"]["held_out_success"])
    assert minutes(found)[-1][0] == pytest.approx(found["made"]["wall_s"] / 60)
    (line,) = controllers_table([found])[2:]
    assert f"| {100 * curve[-1][1]:.1f} |" in line and found["made"]["command"] in line


def test_summary_covers_all_models_and_their_planner():
    def row(variant, seed, success, method="ct"):
        flags = "1" * round(100 * success) + "0" * round(100 * (1 - success))
        return a_row(variant, seed, method, flags, maze="antmaze-large")

    ct = "calm+long-ct"
    planners = [row("published", 0, 0.5, "planner"), row(ct, 0, 0.9, "planner")]
    models = [row(ct, 0, 0.6), row(ct, 1, 0.8), row("cpu-ct", 0, 0.1), row("pt-cql", 0, 0.2, "pt-cql")]
    results = {"ant-cpu": Results(rows=[*planners, *models]), "ant-paper": Results(rows=[row("published", 0, 0.3)])}
    (line,) = (line for line in summary_table(results) if line.startswith("| ant | antmaze-large (seen) | 90 |"))
    _, small, full, lifted, tuned, planner = line.removesuffix(" |").split(" | ")[2:]
    assert small == tuned == "not measured"
    assert re.fullmatch(r"70\.0 \([56]\d to [78]\d\), n = 2", lifted) and re.fullmatch(r"30\.0 .*, n = 1", full)
    assert re.fullmatch(r"90\.0 \(8\d to 9\d\)", planner)


# ----------------------------------------------------------------------------------------------------------- pages


def test_table_is_put_between_its_markers_only():
    text = "a\n<!-- x -->\nold\n<!-- /x -->\n<!-- xy -->\nb\n<!-- /xy -->\n"
    assert put(text, "x", ["new"]) == text.replace("old", "new")
    assert put(put(text, "x", ["1"]), "x", ["old"]) == text


@pytest.fixture(scope="module")
def written():
    return pages.pages()


def test_pages_match_results_files(written):
    """README's summary, docs/results, docs/speed.md and the model cards are up to date."""
    stale = [str(file.relative_to(pages.ROOT)) for file, text in written.items() if file.read_text("utf-8") != text]
    assert not stale, "run: python experiments/pages.py"
    assert {file.name for file in pages.PAGES.glob("*.md")} == {f.name for f in written if f.parent == pages.PAGES}


def test_all_plots_exist():
    assert all(file.is_file() for file in pages.plots())


def test_all_rows_are_on_pages_with_origin(written):
    """No result is left out, and all have their command and commit."""
    for name, found in pages.load_results().items():
        text = written[pages.PAGES / f"{name.partition('-')[0]}.md"]
        for row in [row for kind in LISTS for row in getattr(found, kind)] + found.unmade:
            assert f"`{row.command}` | {row.commit} | {row.hardware} | {row.created[:10]}" in text


def test_markers_come_in_pairs():
    for file in [pages.ROOT / "README.md", *pages.DOCS.rglob("*.md")]:
        opened = re.findall(r"^<!-- ([\w-]+) -->$", file.read_text("utf-8"), re.MULTILINE)
        closed = re.findall(r"^<!-- /([\w-]+) -->$", file.read_text("utf-8"), re.MULTILINE)
        assert opened == closed, file


@pytest.mark.parametrize("name", ["cql", "finetuned", "transfer"])
def test_unwritable_results_file_is_error_before_work(name, tmp_path, monkeypatch):
    script = importlib.import_module(name)
    (tmp_path / "file").write_text("mine")
    monkeypatch.setattr(script, "prepare_jax", lambda: pytest.fail("it began"))
    monkeypatch.setattr(script, "FILE", tmp_path / "file" / "results.json")
    with pytest.raises(UserError, match=f"^{tmp_path / 'file'}: cannot be written"):
        script.main(script.Options())
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("name", ["point", "turtlebot3"])
def test_unwritable_results_of_study_are_error_before_work(name, tmp_path, monkeypatch, capsys):
    script = importlib.import_module(name)
    (tmp_path / f"{name}-cpu.json").mkdir()
    monkeypatch.setattr(Study, "run", lambda *_: pytest.fail("it began"))
    monkeypatch.setattr(sys, "argv", [name])
    for module in (study, script):
        monkeypatch.setattr(module, "RESULTS", tmp_path, raising=False)
    if name == "point":
        with pytest.raises(SystemExit) as stop:
            study.main(name, {}, "")
        assert stop.value.code == 2 and "cannot be written (Is a directory)" in capsys.readouterr().err
    else:
        with pytest.raises(UserError, match=r"cannot be written \(Is a directory\)"):
            script.run()
