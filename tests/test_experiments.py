"""The experiments' plans: which rows there are, and that all of them are made and kept."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

from _variants import Baselines, Plan, plan_for, run_plan

from ct_envs import UserError
from ct_jax.baselines.cql import CqlConfig

pytestmark = pytest.mark.rank_promotion("allow")  # brax's running statistics


@pytest.mark.parametrize("robot", ["point", "ant"])
def test_the_methods_of_the_table(robot):
    plan = plan_for(robot, "cpu", controller="own")
    assert list(plan.variants) == ["published", "bc", "f-ct", "cpu"] and plan.baselines is not None
    published, bc, fct = (plan.variants[name] for name in ("published", "bc", "f-ct"))
    assert replace(bc, model=published.model) == published and not bc.model.returns
    assert fct.rounds == 1 and fct.recover.keep == "separate" and fct.collect == published.collect
    assert not published.reprompt and published.collect.guide == "roadmap" and published.model.frame == "world"


def test_variants_can_be_chosen_and_unknown_ones_are_refused():
    assert list(plan_for("ant", "cpu", controller="zoo", variants=("cpu",)).variants) == ["cpu"]
    assert plan_for("ant", "cpu", controller="zoo", variants=("cpu",)).baselines is None
    assert plan_for("ant", "cpu", controller="zoo", variants=("published", "baselines")).baselines is not None
    with pytest.raises(UserError, match="no variant named 'gpu' with preset 'cpu'; variants: published, bc, f-ct, cpu"):
        plan_for("point", "cpu", controller="own", variants=("gpu",))


def test_every_row_is_made_once_and_kept(tiny, tiny_settings, tmp_path, monkeypatch):
    monkeypatch.setattr("_variants.default_mazes", lambda robot: (("antmaze-umaze",), ("antmaze-medium",)))
    settings = replace(tiny_settings, rounds=0)
    cql = CqlConfig(updates=2, batch=4, width=8, samples=1)
    plan = Plan({"one": settings}, Baselines(cql, replace(settings.sac, iterations=4, warmup=1)))
    rows = run_plan("point", plan, preset="tiny", seeds=(0,), out=tmp_path)
    assert [row["method"] for row in rows] == [*["ct", "planner", "explorer"] * 2, *["pt-cql"] * 2, *["sac"] * 2]
    assert all(row["episodes"] == 4 and row["seed"] == 0 and row["variant"] == "one" for row in rows)
    monkeypatch.setattr("_variants.train_cql", None)  # nothing is learned twice
    assert run_plan("point", plan, preset="tiny", seeds=(0,), out=tmp_path) == rows
