"""The harness of the benchmarks: contestants in turn, ratios per round, results in files; and the scaling estimate."""

import ast
import itertools
import json
import os
import pathlib
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "benchmarks"))

import _harness
import prm as prm_benchmark
import scale
from _harness import Contestant, Options, Results, has_peer, time_together

from ct_envs import UserError, load_maze
from ct_jax.prm import Path

BENCHMARKS = pathlib.Path(_harness.__file__).parent


class Clock:
    """A clock that only contestants advance."""

    def __init__(self, monkeypatch):
        self.now, self.order = 0.0, []
        monkeypatch.setattr(_harness.time, "perf_counter", lambda: self.now)

    def contestant(self, name: str, *seconds: float, work: float = 1.0) -> Contestant:
        spent = itertools.cycle(seconds)

        def run() -> None:
            self.order.append(name)
            self.now += next(spent)

        return Contestant(run, work)


def results(tmp_path, monkeypatch, **options) -> Results:
    monkeypatch.setattr(_harness, "RESULTS", tmp_path / "results")
    return Results(str(tmp_path / "it.py"), Options(**options))


def test_contestants_run_in_turn_after_warm_up(monkeypatch):
    clock = Clock(monkeypatch)
    a, b = clock.contestant("a", 9.0, 1.0, 3.0), clock.contestant("b", 9.0, 2.0, 4.0)
    assert time_together(a, b, repeat=2) == [[1.0, 3.0], [2.0, 4.0]]
    assert clock.order == ["a", "b"] * 3


@pytest.mark.parametrize(("limit_s", "rounds"), [(100.0, 5), (12.0, 3), (0.0, 2)])
def test_slow_race_has_fewer_rounds_but_at_least_two(monkeypatch, limit_s, rounds):
    clock = Clock(monkeypatch)
    a, b = clock.contestant("a", 1.0), clock.contestant("b", 4.0)
    assert time_together(a, b, repeat=5, limit_s=limit_s) == [[1.0] * rounds, [4.0] * rounds]


def test_contestant_without_compilation_has_no_warm_up(monkeypatch):
    clock = Clock(monkeypatch)
    a, b = clock.contestant("a", 1.0), replace(clock.contestant("b", 2.0), compiles=False)
    assert time_together(a, b, repeat=2) == [[1.0] * 2, [2.0] * 2]
    assert clock.order == ["a"] + ["a", "b"] * 2


@pytest.mark.parametrize(("unit", "value", "other"), [("steps/s", 4.0, 1.0), ("ms", 250.0, 1000.0)])
def test_ratio_is_relative_speed(tmp_path, monkeypatch, unit, value, other):
    """For all units, per unit of work and per round."""
    clock = Clock(monkeypatch)
    race = results(tmp_path, monkeypatch, repeat=3, limit_s=60.0)
    ours, rival = clock.contestant("a", 1.0, 2.0, 1.0, 1.0, work=4.0), clock.contestant("b", 2.0, work=2.0)
    race.race("walk", unit, ours, {"rival": rival}, asked={"rival": 3.0})
    (row,) = race._rows
    assert (row["value"], row["other"], row["against"], row["asked"]) == (value, other, "rival", 3.0)
    assert row["ratio"] == {"median": 4.0, "min": 2.0, "max": 4.0}


def test_results_are_written_to_one_file_only(tmp_path, monkeypatch, capsys):
    """The source of the benchmark does not change."""
    source = tmp_path / "it.py"
    source.write_text('"""What it does."""\n')
    for times in (1, 2):
        race = results(tmp_path, monkeypatch)
        race.add("a step of a name that is long " * 3, "ms", [times * 1234.5], against="x", ratios=[2.0], asked=1.5)
        race.finish()
        (row,) = json.loads((tmp_path / "results/it.json").read_text())
        assert {"name", "value", "unit", "against", "ratio", "made"} <= set(row)
        assert row["value"] == times * 1234.5 and f"{1234.5 * times:,.0f}" in capsys.readouterr().out
    assert source.read_text() == '"""What it does."""\n'
    assert sorted(file.name for file in tmp_path.rglob("*")) == ["it.json", "it.py", "results"]


def test_accelerator_has_separate_results_file(tmp_path, monkeypatch):
    monkeypatch.setattr(_harness.jax, "default_backend", lambda: "gpu")
    race = results(tmp_path, monkeypatch)
    race.add("a step", "ms", [1.0])
    race.finish()
    assert [file.name for file in (tmp_path / "results").iterdir()] == ["it-gpu.json"]


def test_results_are_not_written_with_write_false(tmp_path, monkeypatch):
    race = results(tmp_path, monkeypatch, write=False)
    race.add("a", "ms", [1.0])
    race.finish()
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("file", sorted(BENCHMARKS.glob("[a-z]*.py")), ids=lambda file: file.stem)
def test_docstring_of_benchmark_has_its_command(file):
    assert f"python benchmarks/{file.name}" in (ast.get_docstring(ast.parse(file.read_text())) or "")


def test_row_has_commit_from_start_of_make_bench(tmp_path, monkeypatch):
    """Results of earlier benchmarks do not count as changes of the code."""
    monkeypatch.setenv(_harness.COMMIT, "as-it-was")
    race = results(tmp_path, monkeypatch)
    race.add("a step", "ms", [1.0])
    race.finish()
    assert json.loads((tmp_path / "results/it.json").read_text())[0]["made"]["commit"] == "as-it-was"


def test_missing_peer_is_reported(capsys):
    assert has_peer("json", "JSON") and not has_peer("no_such_peer", "Nobody")
    assert capsys.readouterr().out == "Nobody is not installed, so it is not measured: pip install -e '.[bench]'\n"


def test_python_loop_builds_same_roadmap():
    maze = load_maze("antmaze-large")
    roadmap = prm_benchmark.building(maze, 60)()
    walls = np.asarray(maze.walls).tolist()
    graph = prm_benchmark.loop_roadmap(roadmap.points.tolist(), walls, 4.0, roadmap.config.connect_m)
    assert {tuple(sorted(edge)) for edge in graph.edges} == set(map(tuple, roadmap.edges.tolist()))
    table = prm_benchmark.loop_table(graph)
    expected, distance = np.asarray(roadmap.table.next_hop), np.asarray(roadmap.table.distance)
    for goal, hops in table.items():
        for node, hop in hops.items():  # the hop may differ if two paths have the same length
            assert hop == expected[node, goal] or np.isclose(
                distance[node, hop] + distance[hop, goal], distance[node, goal], rtol=1e-5
            )
    found = 0
    for ends in prm_benchmark.building(maze, 20)().points.reshape(-1, 2, 2):
        plan = roadmap.plan(*ends)
        path = prm_benchmark.loop_plan(graph, roadmap.points.tolist(), walls, 4.0, roadmap.config.connect_m, *ends)
        found += bool(path)
        if isinstance(plan, Path):
            np.testing.assert_array_equal(roadmap.points[path[1:-1]], plan.points[1:-1])
        else:
            assert not path
    assert found > 2 and "start" not in graph


# -------------------------------------------------------------------------------------------- the dry run on paper


def scale_options(tmp_path, **rows: float) -> scale.ScaleOptions:
    """Options with results that contain only the given rows, from a machine with two cores."""
    names = {
        "collected": ("rollout", "point, collection guided by explorer", "trajectories/s"),
        "roadmap": ("prm", "200 samples: build and table", "ms"),
        "updates": ("transformer", "point, float32", "steps/s"),
        "flop": ("transformer", "point, float32", "GFLOP/s"),
    }
    made = {"hardware": "x86_64 CPU, 2 cores", "commit": "0"}
    by_file: dict[str, list] = {}
    for which, value in rows.items():
        file, name, unit = names[which]
        by_file.setdefault(file, []).append({"name": name, "unit": unit, "value": value, "made": made})
    for file, content in by_file.items():
        (tmp_path / f"{file}.json").write_text(json.dumps(content))
    return scale.ScaleOptions(robot="point", preset="demo", results=tmp_path, page=tmp_path / "scale.md")


MEASURED = {"collected": 10.0, "roadmap": 20.0, "updates": 2.0, "flop": 100.0}
SIZES = scale.Sizes(trajectory=10_000, step=20, parameters=10**6, state=3 * 10**6, temporary=10**8, messages=10)


@pytest.mark.parametrize("missing", MEASURED)
def test_missing_measurement_names_its_benchmark(tmp_path, missing):
    options = scale_options(tmp_path, **{name: value for name, value in MEASURED.items() if name != missing})
    with pytest.raises(UserError, match=r"has no row '.*' in .*; run: python benchmarks/\w+\.py$"):
        scale.main(options)
    assert not options.page.exists()


def test_page_is_computed_from_measurements(tmp_path):
    options = scale_options(tmp_path, **MEASURED)
    scale.main(options)
    page = options.page.read_text()
    assert "| point, collection guided by explorer | 10 trajectories/s | x86_64 CPU, 2 cores, commit 0 |" in page
    assert page.count("| memory of a GPU |") == 3 and "## Limits and remedies" in page and "nan" not in page


@pytest.mark.parametrize("robot", ["point", "ant"])
def test_measured_update_time_of_gpu_is_used(tmp_path, robot):
    """A measurement of another robot is not used; then that of the CPU is."""
    options = scale_options(tmp_path, **MEASURED)
    made = {"hardware": "1 x NVIDIA, x86_64 CPU, 16 cores", "commit": "0"}
    rows = [
        {"name": f"{robot}, bfloat16", "unit": unit, "value": value, "made": made}
        for unit, value in (("steps/s", 200.0), ("GFLOP/s", 9.0))
    ]
    (tmp_path / "transformer-gpu.json").write_text(json.dumps(rows))
    found = scale.measured(options, 200)
    assert scale.on_gpu(found) == (robot == "point")
    if robot == "point":
        assert scale.update_s(found, scale.Assumed()) == 1 / 200.0


def test_more_hosts_need_less_memory_and_more_communication(tmp_path):
    """Memory, computation and roadmaps shrink with the number of hosts; communication does not."""
    options = scale_options(tmp_path, **MEASURED)
    settings, assumed = scale.get_preset("paper", "point"), scale.Assumed()
    found = scale.measured(options, settings.prm.samples)
    one, two, many = (scale.plan(n, options, settings, found, SIZES, assumed) for n in (1, 2, 64))
    assert one.used == assumed.gpus and many.used == settings.fit.batch
    for smaller, larger in ((two, one), (many, two)):
        assert smaller.gpu < larger.gpu and smaller.host < larger.host and smaller.compute < larger.compute
        assert smaller.rollouts < larger.rollouts and smaller.roadmaps < larger.roadmaps
        assert smaller.traffic > larger.traffic
    assert one.rollouts == pytest.approx(options.trajectories / (10.0 / 2 * assumed.cores))
    loads = [limit.load for limit in scale.limits(many, options, settings, assumed)]
    assert loads == sorted(loads, reverse=True)


def test_unwritable_results_are_error_before_timing(tmp_path, monkeypatch):
    (tmp_path / "results").write_text("mine")
    with pytest.raises(UserError, match=f"^{tmp_path / 'results'}: cannot be written"):
        results(tmp_path, monkeypatch)
    results(tmp_path, monkeypatch, write=False)


def test_benchmark_without_device_is_error_of_one_line(tmp_path):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "JAX_PLATFORMS": "nonsense"}
    command = [sys.executable, str(BENCHMARKS / "prm.py"), "--no-write"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert (
        done.returncode == 2 and done.stderr.count("\n") == 1 and done.stderr.startswith("error: JAX finds no device")
    )
    assert list(tmp_path.iterdir()) == []
