"""The experiments' plans: which rows there are, and that all of them are made and kept."""

import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

from _variants import Plan, digest, plan_for, run_plan, share, untuned, write_results
from controllers import described, minutes, table
from table import (
    differences,
    finetuned_table,
    interval_of_mean,
    method_name,
    pooled,
    reasons,
    room_table,
    summary_table,
    transfer_table,
    with_tables,
)
from turtlebot3 import variants_for

from ct_envs import MazeEnv, UserError
from ct_envs.robots import get_robot
from ct_jax.baselines.cql import CqlConfig
from ct_jax.baselines.sac_alone import SacAlone
from ct_jax.checkpoint import read_json
from ct_jax.controllers.sac import SacConfig
from ct_jax.finetune import NoRecoveryError
from ct_jax.presets import get_preset, with_fits
from ct_jax.run import Run, load_mazes

MADE = {"command": "python x.py", "commit": "abc", "hardware": "CPU", "created": "2026-01-01T00:00:00"}

pytestmark = pytest.mark.rank_promotion("allow")  # brax's running statistics


def fits_of(settings):
    """The trainings of a fine-tuned transformer, first to last."""
    return [settings.fit, *[settings.round_fit] * (settings.rounds - 1), settings.last_fit]


@pytest.mark.parametrize("robot", ["point", "ant", "humanoid"])
def test_the_methods_of_the_table(robot):
    plan = plan_for(robot, "cpu", controller="own")
    skill = ["skill"] if robot != "humanoid" else []  # whose cpu has it
    lifts = [
        "cpu",
        "mazes",
        "modes",
        "calm",
        "memory",
        *skill,
        "calm+memory",
        *[f"calm+memory+{name}" for name in skill],
        "long",
        "calm+long",
    ]
    lifted = [name for lift in lifts for name in (f"{lift}-ct", lift)]
    roaming = ["roam", "modes+roam", "modes+memory-ct", "modes+memory+roam"]
    assert list(plan.variants) == ["published", "bc", "f-ct", "pt-cql", "sac", *lifted, *roaming]
    for name in ("roam", "modes+roam", "modes+memory+roam"):  # CT of the one maze, failures of many
        tuned, ct = plan.variants[name], plan.variants[untuned(name)]
        assert tuned.recover.random_mazes > 0 == tuned.random_mazes == ct.random_mazes and tuned.collect == ct.collect
    assert list(plan.baselines) == ["pt-cql", "sac"]
    assert all(plan.variants[name] == plan.variants["published"] for name in plan.baselines)  # the same data
    published, bc, fct = (plan.variants[name] for name in ("published", "bc", "f-ct"))
    assert replace(bc, model=published.model) == published and not bc.model.returns
    assert fct.rounds == 1 and fct.recover.keep == "separate" and fct.collect == published.collect
    assert not published.reprompt and published.collect.guide == "roadmap" and published.model.frame == "world"
    stuck = {"point": (40, 20), "ant": (80, 40), "humanoid": (120, 60)}
    assert (fct.recover.stuck_steps, fct.recover.bumps) == stuck[robot]
    lifted_ct, lifted = (plan.variants[name] for name in ("cpu-ct", "cpu"))
    assert lifted_ct.rounds == 0 < lifted.rounds and lifted_ct.collect == lifted.collect
    of_many_ct, of_many = (plan.variants[name] for name in ("mazes-ct", "mazes"))
    assert of_many_ct.rounds == 0 < of_many.rounds and of_many_ct.collect == of_many.collect
    assert of_many_ct.random_mazes == of_many.random_mazes > 0
    assert of_many_ct.fit.updates == sum(fit.updates for fit in fits_of(of_many))  # neither learns longer
    for name, one in (("modes-ct", lifted_ct), ("modes", lifted)):  # nothing else differs
        assert replace(plan.variants[name], model=one.model) == one and plan.variants[name].model.modes > 1
    for name, one in (("skill-ct", lifted_ct), ("skill", lifted)):
        found = plan.variants[name] if robot != "humanoid" else one
        assert found == with_fits(replace(one, model=replace(one.model, skill=True)), turns=robot != "point")
    for name, one in (("memory-ct", lifted_ct), ("memory", lifted)):
        assert replace(plan.variants[name], model=one.model) == one and plan.variants[name].model.stride > 1
        assert plan.variants[f"calm+{name}"] == replace(plan.variants[name], controller_effort=0.75)
    for name in ("calm-ct", "calm"):
        one, longer = plan.variants[name], plan.variants[name.replace("calm", "calm+long")]
        assert fits_of(longer)[-1 if one.rounds else 0].updates == 2 * fits_of(one)[-1 if one.rounds else 0].updates
        assert replace(longer, fit=one.fit, last_fit=one.last_fit) == one
    assert plan.variants["modes"].model.commitment > plan.variants["modes-ct"].model.commitment == 0.0
    SacAlone(MazeEnv(robot, engine="mujoco"), replace(plan.baselines["sac"], replay=2000))  # its settings are for it


def test_variants_can_be_chosen_and_unknown_ones_are_refused():
    assert list(plan_for("ant", "cpu", controller="zoo", variants=("cpu",)).variants) == ["cpu"]
    assert list(plan_for("ant", "cpu", controller="zoo", variants=("cpu", "sac")).variants) == ["sac", "cpu"]
    with pytest.raises(
        UserError, match="no variant named 'gpu' with preset 'cpu'; variants: published, bc, f-ct, pt-cql"
    ):
        plan_for("point", "cpu", controller="own", variants=("gpu",))


def test_every_size_has_every_method_of_the_paper():
    paper = plan_for("ant", "paper", controller="zoo")
    assert list(paper.variants) == ["published", "bc", "f-ct", "pt-cql", "sac"]
    sizes = [(settings.model.width, settings.fit.updates, settings.controller) for settings in paper.variants.values()]
    assert sizes == [(512, 75_000, "zoo")] * 5
    assert list(plan_for("ant", "demo", controller="own").variants) == ["demo"]
    for robot in ("point", "ant"):
        sac = plan_for(robot, "cpu", controller="zoo").baselines["sac"]
        assert isinstance(sac, SacConfig) and sac.iterations >= 8 * get_robot(robot).horizon


def test_every_row_is_made_once_and_kept(tiny, tiny_run, tiny_settings, tmp_path, monkeypatch):
    """A finished run is taken as it is, the baselines are learned from its data, and nothing is done twice."""
    shutil.copytree(tiny_run.folder, tmp_path / "one-0")
    mazes = ((tiny_run.arguments[tiny_run.arguments.index("--maze") + 1],), ("antmaze-umaze",))
    monkeypatch.setattr("_variants.default_mazes", lambda robot: mazes)
    cql = CqlConfig(updates=2, batch=4, width=8, samples=1)
    sac = replace(tiny_settings.sac, iterations=4, warmup=1)
    plan = Plan(dict.fromkeys(("one", "pt-cql", "sac"), tiny_settings), {"pt-cql": cql, "sac": sac})
    rows = run_plan("point", plan, preset="tiny", seeds=(0,), out=tmp_path)
    assert [row["method"] for row in rows] == [*["ct", "planner", "explorer"] * 2, *["pt-cql"] * 2, *["sac"] * 2]
    assert [row["variant"] for row in rows] == [*["one"] * 6, *["pt-cql"] * 2, *["sac"] * 2]
    assert all(row["episodes"] == 4 and row["seed"] == 0 for row in rows)
    assert all(0 < row.get("learn_wall_s", 0) <= row["run_wall_s"] for row in rows if row["method"] in plan.baselines)
    monkeypatch.setattr("_variants.train_cql", None)
    assert run_plan("point", plan, preset="tiny", seeds=(0,), out=tmp_path) == rows
    other = Plan(plan.variants, plan.baselines | {"pt-cql": replace(cql, updates=3)})
    with pytest.raises(UserError, match="other settings; delete it"):
        run_plan("point", other, preset="tiny", seeds=(0,), out=tmp_path)


def test_sac_alone_needs_nothing_of_the_method(tiny_settings, tmp_path, monkeypatch):
    """No controller, no trajectories: its run holds a policy and its rows."""
    monkeypatch.setattr("_variants.default_mazes", lambda robot: (("antmaze-umaze",), ()))
    sac = replace(tiny_settings.sac, iterations=4, warmup=1)
    (row,) = run_plan(
        "point", Plan({"sac": tiny_settings}, {"sac": sac}), preset="tiny", seeds=(0,), out=tmp_path
    )  # fmt: skip
    assert row["method"] == "sac" and "controller" not in row
    assert not any((tmp_path / "sac-0" / stage).exists() for stage in ("controller", "collect", "fit"))


def test_references_appear_once_for_each_margin(tiny_settings, tmp_path, monkeypatch):
    """What keeps away from walls is another planner: it stands beside what was taught by it."""
    plan = Plan({
        "one": tiny_settings, "two": replace(tiny_settings, rounds=2),
        "wary": replace(tiny_settings, prm=replace(tiny_settings.prm, margin_m=0.3)),
    })  # fmt: skip
    monkeypatch.setattr("_variants.pipeline.train", lambda run, resume: None)
    monkeypatch.setattr("_variants.share", lambda source, run: None)
    monkeypatch.setattr("_variants.outcomes", lambda folder, row: {})
    monkeypatch.setattr("_variants.read_json", lambda file: MADE)
    monkeypatch.setattr("_variants.controller_digest", lambda where, robot: "abc")
    found = [{"method": method, "maze": "m"} for method in ("ct", "planner")]
    monkeypatch.setattr("_variants.pipeline.results", lambda folder: found)
    rows = run_plan("point", plan, preset="tiny", seeds=(0, 1), out=tmp_path)
    planners = [row for row in rows if row["method"] == "planner"]
    assert [(row["variant"], row["margin_m"]) for row in planners] == [
        ("one", tiny_settings.prm.margin_m),
        ("wary", 0.3),
    ]
    assert [method_name(row) for row in planners] == ["planner", "planner, 0.3 m off walls"]
    assert len(rows) == 2 * 3 + 2


def test_a_run_that_cannot_be_finished_stops_no_other(tiny_settings, tmp_path, monkeypatch):
    def found_of(run, baseline, name):
        if name == "one":
            raise UserError("full disk")
        return [{"method": "ct", "maze": "m"}]

    monkeypatch.setattr("_variants.share", lambda source, run: None)
    monkeypatch.setattr("_variants.found_of", found_of)
    monkeypatch.setattr("_variants.label", lambda run, name, row: {"variant": name} | row)
    kept = []
    with pytest.raises(UserError, match="one-0: full disk"):
        run_plan(
            "point", Plan(dict.fromkeys(("one", "two"), tiny_settings)), preset="tiny", seeds=(0,), out=tmp_path,
            keep=kept.append,
        )  # fmt: skip
    assert [row["variant"] for row in kept[-1]["rows"]] == ["two"] and not kept[-1]["unmade"]


def test_f_ct_that_finds_nothing_to_learn_from_is_a_result(tiny_settings, tmp_path, monkeypatch):
    """The others go on, the reason stands in the results until there is a row, and under the table."""

    def found_of(run, baseline, name):
        if name == "f-ct":
            raise NoRecoveryError("no recovery in 9 episodes")
        return [{"method": "ct", "maze": "m"}]

    made = {"command": "python x.py", "commit": "abc", "hardware": "CPU", "created": "2026-01-01T00"}
    monkeypatch.setattr("_variants.share", lambda source, run: None)
    monkeypatch.setattr("_variants.found_of", found_of)
    monkeypatch.setattr("_variants.label", lambda run, name, row: row | made | {"variant": name, "model_seed": 0})
    file = tmp_path / "results.json"
    plan = Plan(dict.fromkeys(("f-ct", "published"), tiny_settings))
    run_plan(
        "point", plan, preset="tiny", seeds=(0,), out=tmp_path, keep=lambda found: write_results(file, found)
    )  # fmt: skip
    found = read_json(file)
    assert [row["variant"] for row in found["rows"]] == ["published"]
    told = "\n".join(reasons(found["unmade"]))
    assert "Without a row: F-CT, seed 0: no recovery in 9 episodes (`python x.py`; commit abc" in told
    write_results(file, {"rows": [{"variant": "f-ct", "model_seed": 0, "method": "ct", "maze": "m"}]})
    assert read_json(file)["unmade"] == reasons([]) == []


def test_variants_share_what_would_come_out_alike(tiny_run, tiny_settings, tmp_path):
    def run(name, **changes):
        maze = load_mazes((tiny_run.arguments[tiny_run.arguments.index("--maze") + 1],))
        return Run(tmp_path / name, "point", "tiny", replace(tiny_settings, **changes), maze, {}, 0, "auto")

    source = replace(run("source"), folder=tiny_run.folder)
    others = {
        "rounds": run("rounds", rounds=2),
        "model": run("model", model=replace(tiny_settings.model, returns=False)),
        "collect": run("collect", collect=replace(tiny_settings.collect, noise=0.1)),
        "mazes": run("mazes", random_mazes=2),
        "prm": run("prm", prm=replace(tiny_settings.prm, samples=50)),
    }
    taken = {"rounds": 3, "model": 2, "collect": 1, "mazes": 1, "prm": 0}
    for name, other in others.items():
        share(source, other)
        stages = [stage for stage in ("controller", "collect", "fit") if other.done(stage) is not None]
        assert stages == ["controller", "collect", "fit"][: taken[name]]
        rows = {file.stem.rpartition("-")[2] for file in (other.folder / "evaluate").glob("*.json")}
        assert rows == (set() if name == "prm" else {"planner", "explorer"})


def test_rows_of_other_sittings_stay_in_the_results(tmp_path):
    def row(variant, seed, success, method="ct"):
        return {"variant": variant, "model_seed": seed, "method": method, "maze": "m", "success_rate": success}

    file = tmp_path / "new" / "results.json"
    write_results(file, {"rows": [row("ct", 0, 0.1), row("ct", 0, 0.9, "planner")], "noise": [row("ct", 0, 0.3)]})
    write_results(file, {"rows": [row("ct", 1, 0.2), row("bc", 0, 0.3), row("bc", 0, 0.8, "planner")]})
    write_results(file, {"rows": [row("ct", 0, 0.4)]})
    found = read_json(file)
    assert [(r["variant"], r["model_seed"], r["method"], r["success_rate"]) for r in found["rows"]] == [
        ("ct", 1, "ct", 0.2), ("bc", 0, "ct", 0.3), ("bc", 0, "planner", 0.8), ("ct", 0, "ct", 0.4),
    ]  # fmt: skip
    assert found["noise"] == [row("ct", 0, 0.3)]
    anew = row("bc", 0, 0.7, "planner") | {"margin_m": 0.0}  # earlier rows do not name the margin that they had not
    wary = row("cpu", 0, 0.9, "planner") | {"margin_m": 0.3}
    write_results(file, {"rows": [anew, wary]})
    assert [r for r in read_json(file)["rows"] if r["method"] == "planner"] == [anew, wary]


def test_rows_of_other_settings_do_not_stay_under_the_same_name(tmp_path):
    """A variant that was changed is measured anew, all of it: no table joins what was trained in two ways."""

    def row(variant, seed, settings, method="ct"):
        return {"variant": variant, "model_seed": seed, "settings": settings, "method": method, "maze": "m"}

    file = tmp_path / "results.json"
    old = [row("cpu", 0, "old"), row("cpu", 1, "old"), row("cpu", 0, "old", "planner"), row("ct", 0, "ct's")]
    write_results(file, {"rows": old, "noise": [row("cpu", 0, "old")]})
    write_results(file, {"rows": [row("cpu", 0, "new")]})
    assert read_json(file) == {"rows": [*old[2:], row("cpu", 0, "new")], "noise": []}
    settings = get_preset("cpu")
    assert digest(settings) == digest(get_preset("cpu")) != digest(replace(settings, rounds=1))


def test_what_fine_tuning_adds_is_told_pair_by_pair():
    def row(variant, seed, outcomes):
        return {"variant": variant, "method": "ct", "model_seed": seed, "outcomes": {"success": outcomes}}

    half = "01" * 50
    rows = {"CT": [row("published", 0, half), row("published", 1, half)],
            "F-CT": [row("f-ct", 1, "1" * 100), row("f-ct", 0, half)]}  # fmt: skip
    *_, line = differences({(True, "m", name): models for name, models in rows.items()})
    assert line.startswith("| m | F-CT less CT | +25.0 (+0.0 to +5") and line.endswith(" | 2 |")
    rows["F-CT"] = [row | {"controller": "another"} for row in rows["F-CT"]]
    assert differences({(True, "m", name): models for name, models in rows.items()}) == []
    with_itself = interval_of_mean(np.zeros((3, 100)))
    assert with_itself == (0.0, 0.0)
    low, high = interval_of_mean(np.tile([0.0, 1.0], (3, 50)))
    assert 0.38 < low < 0.42 and 0.58 < high < 0.62  # as a binomial's, were models alike


def test_models_that_differ_are_less_certain_than_episodes_are_many():
    """Rates of 88, 84 and 78 of 100 are not known to two of 100; three that agree are, and one is as Wilson says."""

    def row(rate):
        flags = "1" * round(500 * rate) + "0" * round(500 * (1 - rate))
        return {"episodes": 500, "success_rate": rate, "outcomes": {"success": flags}}

    def width(*rates):
        low, high = re.findall(r"\((\d+) to (\d+)\)", pooled([row(rate) for rate in rates], "success"))[0]
        return int(high) - int(low)

    assert width(0.884, 0.836, 0.78) >= 8
    assert width(0.836) in (6, 7) and width(0.836, 0.836, 0.836) in (6, 7)  # the same pairs three times


def test_the_turtlebots_rows_share_what_they_can():
    known = variants_for("cpu")
    assert list(known)[:4] == ["ct", "bc-ct", "f-ct", "cpu-ct"]
    assert list(known)[4:] == ["cpu-ct-v", "cpu-ct-actions", "cpu", "noise-ct", "noise", "dense"]
    lifted, seeing = known["cpu-ct"], known["cpu-ct-actions"]
    assert known["cpu-ct-v"] == replace(lifted, optimism=1.0)
    asked = replace(known["cpu"], rounds=0, optimism=lifted.optimism)
    assert replace(asked, fit=replace(asked.fit, shift_timestep=300)) == lifted and lifted.optimism < 1.0
    assert replace(seeing, model=lifted.model) == lifted and seeing.model.actions and not lifted.model.actions
    densities = [known[name].rooms.densities for name in ("cpu", "dense")]  # pyright: ignore
    assert densities == [(1.0, 1.0), (0.5, 2.0)]
    ct, bc, fct = (known[name] for name in ("ct", "bc-ct", "f-ct"))
    assert replace(fct, rounds=0) == ct and fct.rounds == 1 and fct.recover.keep == "separate"
    assert replace(bc, model=ct.model) == ct and not bc.model.returns
    assert (ct.model.layers, ct.model.heads, ct.model.width, ct.model.context) == (4, 4, 128, 5)
    assert (ct.fit.batch, ct.fit.learning_rate, ct.fit.updates, ct.fit.warmup) == (128, 1e-4, 15_000, 10_000)
    assert list(variants_for("cpu", ("cpu",))) == ["cpu"]
    with pytest.raises(UserError, match="no variant named 'gpu'"):
        variants_for("cpu", ("gpu",))


def test_the_turtlebots_table_joins_models_and_counts_no_row_twice():
    def row(variant, seed, density, success, **more):
        rates = {"success_rate": success, "frontal_rate": 0.0, "grazing_rate": 0.1}
        made = MADE | {"worlds": 20, "pairs": 25}
        what = {"variant": variant, "method": "ct", "model_seed": seed, "density": density, "noise": 0.0, "spl": 0.5}
        return what | rates | made | {"episodes": 500, "seed": 0, "run_wall_s": 600, "collect_wall_s": 300} | more

    rows = [row("ct", 0, 1.0, 0.9), row("ct", 1, 1.0, 1.0)]
    seven = [row("ct", 0, 1.0, 0.9, full=60, partial=5, failed=5)]
    lines = room_table({"rows": rows, "density": [row("ct", 0, 1.5, 0.8)], "seven": seven})
    assert [line.split(" | ")[3] for line in lines[2:4]] == ["95.0 (93 to 96)", "80.0 (76 to 83)"]
    assert "| 90, 100 |" in lines[2] and lines[-3].endswith(
        "ct 10 min (of them, for the planning trajectories: 5.0 to 5.0)."
    )
    assert "ct, 2 models" in lines[2] and any("| 60 | 5 | 5 |" in line for line in lines)


def test_what_fine_tuning_adds_is_counted_pair_by_pair_and_for_each_f_ct_apart():
    def row(variant, seed, successes):
        head = {"robot": "point", "maze": "m", "variant": variant, "model_seed": seed, "seed": 1, "episodes": 4}
        head["controller"] = "one"
        rates = {"success_rate": successes.count("1") / 4, "outcomes": {"success": successes}}
        return head | rates | MADE | {"trained": MADE}

    one = [row("cpu", 0, "1111"), row("cpu-ct", 0, "0000")]
    many = [row("mazes-ct", 1, "0011"), row("mazes-ct", 0, "1100"), row("mazes", 0, "1110"), row("mazes", 1, "0110")]
    lines = [line.split(" | ") for line in finetuned_table({"rows": [*many, *one]})[2:4]]
    assert [line[1:6] for line in lines] == [
        ["`mazes`", "`mazes-ct`", "m", "2", "4"],
        ["`cpu`", "`cpu-ct`", "m", "1", "4"],
    ]
    assert [line[-1].split()[0] for line in lines] == ["+12.5", "+100.0"]
    assert finetuned_table({"rows": [*one, *many]})[3] == finetuned_table({"rows": [*many, *one]})[2]  # in any order
    roaming = [row("roam", 0, "1101"), row("roam", 1, "1111")]  # of whose CT, cpu-ct, there is no seed 1
    (line,) = (line for line in finetuned_table({"rows": [*one, *roaming]}) if "roam" in line)
    assert line.split(" | ")[4] == "1" and "+75.0" in line
    longer = finetuned_table({"rows": [*one, *roaming, row("long-ct", 1, "0111")]})
    (line,) = (line for line in longer if "`roam` | `long-ct`" in line)
    assert line.split(" | ")[4] == "1" and "+25.0" in line


def test_the_table_of_transfer_says_when_most_of_the_final_success_was_there():
    made = MADE | {"episodes": 100}
    curves = {("scratch", 0): (0.0, 0.2, 0.8), ("scratch", 1): (0.0, 0.4, 1.0), ("ant", 0): (0.5, 0.85, 0.9)}
    rows = [
        {"robot": "point", "run": "cpu-0", "start": start, "source": None if start == "scratch" else "cpu-0"}
        | {"seed": seed, "updates": mark, "success_rate": rate}
        | made
        for (start, seed), curve in curves.items()
        for mark, rate in zip((25, 50, 100), curve, strict=True)
    ]
    lines = transfer_table({"rows": rows})
    # 51 of 60 points of the way from 50 to 100
    assert lines[2] == "| point | `cpu-0` | from scratch | 2 | 0 | 30 | 90 | 90 |"
    assert lines[3] == "| point | `cpu-0` | from the trunk of the ant's cpu-0 | 1 | 50 | 85 | 90 | 46 |"


def test_a_shipped_controller_says_how_it_was_learned(tiny_run):
    found = described(tiny_run.folder)
    curve, config = found["made"]["curve"], found["sac"]
    assert curve and curve[-1] == (config["iterations"], found["made"]["held_out_success"])
    assert minutes(found)[-1][0] == pytest.approx(found["made"]["wall_s"] / 60)
    (line,) = table([found])[2:]
    assert f"| {100 * curve[-1][1]:.1f} |" in line and found["made"]["command"] in line


def test_the_readme_shows_what_was_measured():
    text = (Path(__file__).parents[1] / "README.md").read_text("utf-8")
    assert with_tables(text) == text


def test_the_summary_is_of_all_models_and_of_the_planner_that_led_them():
    def row(variant, seed, success, method="ct"):
        where = {"maze": "antmaze-large", "seen": True, "episodes": 100}
        return {"variant": variant, "model_seed": seed, "success_rate": success, "method": method} | where

    ct = "calm+long-ct"
    planners = [row("published", 0, 0.5, "planner"), row(ct, 0, 0.9, "planner")]
    models = [row(ct, 0, 0.6), row(ct, 1, 0.8), row("cpu-ct", 0, 0.1), row("pt-cql", 0, 0.2, "pt-cql")]
    results = {"ant-cpu": {"rows": [*planners, *models]}, "ant-paper": {"rows": [row("published", 0, 0.3)]}}
    (line,) = (line for line in summary_table(results) if line.startswith("| ant | antmaze-large (seen) | 90 |"))
    _, small, full, lifted, tuned, planner = line.removesuffix(" |").split(" | ")[2:]
    assert small == tuned == "not measured"
    assert re.fullmatch(r"70\.0 \(6\d to 7\d\), n = 2", lifted) and re.fullmatch(r"30\.0 .*, n = 1", full)
    assert re.fullmatch(r"90\.0 \(8\d to 9\d\)", planner)
