"""The command line: arguments, output, and errors of one line for bad input."""

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from ct_envs.maze import load_walls, maze_names
from ct_jax import __version__, cli, pipeline
from ct_jax.cli import main
from ct_jax.settings import Settings

pytestmark = pytest.mark.rank_promotion("allow")

ROOT = Path(__file__).parents[1]
ROW = (
    "robot", "method", "maze", "episodes", "seed", "success_rate", "success_ci95", "return_mean", "return_scaled",
    "spl", "collision_rate", "timeout_rate", "steps_mean", "wall_s",
)  # fmt: skip


def shell(*arguments, **options):
    """Run ``python ...`` in a separate process."""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "envs")])
    environment = os.environ | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"} | options.pop("env", {})
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=environment, **options)


def refused(capsys, *arguments):
    """The error line of a command."""
    capsys.readouterr()
    assert main([str(each) for each in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and err.startswith("error: ") and "Traceback" not in err
    return err


# ---------------------------------------------------------------------------------------------------- the commands


def test_train_prints_table_and_paths(tiny_run):
    lines = tiny_run.stdout.splitlines()
    assert lines[0].split()[:3] == ["maze", "method", "success"]
    assert [line.split()[0] for line in lines[1:7]] == ["islands"] * 3 + ["antmaze-umaze"] * 3
    assert lines[-2:] == [f"model:  {tiny_run.folder / 'model'}", f"report: {tiny_run.folder / 'report.html'}"]
    assert "controller: done in" in tiny_run.stderr and "\x1b" not in tiny_run.stdout + tiny_run.stderr


@pytest.mark.parametrize(("rates", "shown"), [([0.0, 0.0], False), ([0.0, 0.25], True), ([None, None], False)])
def test_table_shows_divergence_only_if_it_occurred(capsys, rates, shown):
    row = {"maze": "hall", "method": "ct", "success_rate": 0.5, "success_ci95": [0.1, 0.9], "spl": 0.5}
    row |= {"return_scaled": -1.0, "collision_rate": 0.0, "steps_mean": 3.0}
    cli.print_rows([row | ({} if rate is None else {"diverged_rate": rate}) for rate in rates])
    out = capsys.readouterr().out
    assert ("diverged %" in out) == shown and ("25" in out) == shown


def test_evaluate_takes_a_map_that_somebody_else_made(tiny_run, islands, tmp_path, capsys):
    """Drawn finely, with a scale: the same maze, and so the same row."""
    walls = load_walls(islands)[::-1].repeat(8, 0).repeat(8, 1)
    Image.fromarray(np.where(walls, 0, 255).astype(np.uint8)).save(tmp_path / "floor.png")
    settings = {"image": "floor.png", "resolution": 0.5, "origin": [1, 2, 0], "negate": 0}
    file = tmp_path / "floor.yaml"
    file.write_text(json.dumps(settings | {"occupied_thresh": 0.65, "free_thresh": 0.196}))
    rows = []
    for maze in (islands, file):
        assert main(["evaluate", str(tiny_run.folder), "--maze", str(maze), "--episodes", "3", "--json"]) == 0
        rows.append(json.loads(capsys.readouterr().out))
    for name in set(ROW) - {"wall_s", "maze"}:
        assert rows[0][name] == pytest.approx(rows[1][name]), name


def test_json_is_only_output_on_stdout(tiny_run, islands):
    """In a real process, where libraries may print."""
    done = shell(
        "-m", "ct_jax.cli", "evaluate", str(tiny_run.folder), "--maze", str(islands), "--episodes", "2", "--seed", "3",
        "--method", "planner", "--json", env={"XDG_CACHE_HOME": str(tiny_run.folder.parent / "cache")},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    row = json.loads(done.stdout, parse_constant=pytest.fail)
    assert done.stdout.count("\n") == 1 and row.keys() >= set(ROW)
    head = {"robot": "point", "method": "planner", "maze": str(islands), "episodes": 2, "seed": 3}
    assert row | head == row
    assert 0 <= row["success_ci95"][0] <= row["success_rate"] <= row["success_ci95"][1] <= 1


def test_imports_print_nothing():
    """Missing optional libraries print nothing either. The first output of an experiment is its help."""
    assert shell("-c", "from ct_envs import MazeEnv").stdout == ""
    assert shell("experiments/point.py", "--help", cwd=ROOT).stdout.lstrip().startswith("usage:")


@pytest.mark.parametrize("method", ["ct", "planner", "explorer"])
def test_evaluate_reproduces_row_of_run(method, tiny, tiny_run, capsys):
    """The same seed gives the same pairs in the run and afterwards."""
    whole = [r for r in pipeline.results(tiny_run.folder) if (r["maze"], r["method"]) == ("antmaze-umaze", method)]
    command = ["evaluate", str(tiny_run.folder), "--maze", "antmaze-umaze", "--episodes", "4", "--method", method]
    assert main([*command, "--json"]) == 0
    row = json.loads(capsys.readouterr().out)
    for name in set(ROW) - {"wall_s"}:
        assert row[name] == pytest.approx(whole[0][name]), name


def test_evaluate_uses_given_return_scale(tiny_run, monkeypatch, capsys):
    asked = []

    def listen(request, model, method, seed, keep):
        asked.append(model.policy.return_scale)
        keep(row := {"robot": model.robot})
        return row

    monkeypatch.setattr(pipeline, "answer", listen)
    command = ["evaluate", str(tiny_run.folder), "--maze", "antmaze-umaze", "--episodes", "2", "--json"]
    rows = []
    for more in ([], ["--return-scale", "0.5"]):
        assert main([*command, *more]) == 0
        rows.append(json.loads(capsys.readouterr().out))
    assert asked == [Settings().return_scale, 0.5]
    assert "return_scale" not in rows[0] and rows[1]["return_scale"] == 0.5


def test_other_robots_work_without_pybullet(tiny_run, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    command = ["evaluate", str(tiny_run.folder), "--maze", "antmaze-umaze", "--episodes", "2", "--json"]
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 2
    assert "needs PyBullet" in refused(capsys, "evaluate", "zoo:turtlebot3", "--worlds", "1", "--pairs", "1")


def test_evaluate_prints_table(tiny, tiny_run, tmp_path, capsys):
    arguments = ["evaluate", str(tiny_run.folder), "--maze", "antmaze-umaze", "--episodes", "4"]
    assert main([*arguments, "--picture", str(tmp_path / "paths.svg")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and lines[1].split()[:2] == ["antmaze-umaze", "ct"]
    assert "point, ct in antmaze-umaze: " in (tmp_path / "paths.svg").read_text()


def test_report_command_writes_report(tiny, tiny_run, tmp_path, capsys):
    folder = shutil.copytree(tiny_run.folder, tmp_path / "run")
    (folder / "report.html").unlink()
    assert main(["report", str(folder)]) == 0
    assert capsys.readouterr().out == f"{folder / 'report.html'}\n" and (folder / "report.html").is_file()


def test_mazes_shows_all_mazes(capsys):
    assert main(["mazes"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in maze_names()) and "██" in out


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"ct-jax {__version__}\n"


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ([], ["train", "evaluate", "report", "mazes", "examples:", "ct-jax train point --preset demo"]),
        (["train"], ["ROBOT", "--preset", "--out", "--seed", "--maze", "--eval-maze", "--random-mazes", "--resume"]),
        (["train"], ["examples:", "--resume", "runs/ROBOT-PRESET-SEED", "cell is 4 m wide"]),
        (
            ["evaluate"],
            ["RUN", "--maze", "--episodes", "--seed", "--method", "--return-scale", "--json", "zoo:point", "examples:"],
        ),
        (["report"], ["RUN", "ct-jax report runs/demo"]),
        (["mazes"], ["ct-jax mazes"]),
        (["maps"], ["show|convert", "FILE", "--resolution", "--cell-m", "--scale", "--picture", "examples:"]),
        (["train"], ["mjx is some 30 times slower", "hosts that you trust"]),
        (["evaluate"], ["mjx is some 30 times slower"]),
    ],
)
def test_help_contains_options_and_examples(command, words, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    out, err = capsys.readouterr()
    assert stop.value.code == 0 and err == ""
    out = " ".join(out.split())  # ignore line breaks
    assert [word for word in words if word not in out] == []


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["mazes"], ["train", "bob"], ["train"]])
def test_light_commands_do_not_import_physics(arguments):
    heavy = ["mujoco", "brax", "orbax", "tensorboardX", "matplotlib"] + ["jax"] * (arguments != ["mazes"])
    code = f"""
import sys
from ct_jax import cli
try:
    status = cli.main({arguments!r})
except SystemExit as stop:
    status = stop.code
print("heavy:", status, [name for name in {heavy!r} if name in sys.modules])"""
    done = shell("-c", code)
    assert done.stdout.splitlines()[-1] in ("heavy: 0 []", "heavy: 2 []"), done.stdout + done.stderr


# --------------------------------------------------------------------------------------------------- bad arguments


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["give a command", "train, evaluate, report, mazes"]),
        (["bogus"], ["bogus", "--help"]),
        (["train"], ["missing", "ROBOT", "ct-jax train --help"]),
        (["evaluate"], ["missing", "RUN", "ct-jax evaluate --help"]),
        (["train", "point", "extra"], ["extra"]),
        (["train", "point", "--preset"], ["--preset"]),
        (["train", "point", "--sneed", "3"], ["--sneed", "ct-jax train --help"]),
        (["train", "point", "--seed", "many"], ["--seed", "'many'", "whole number"]),
        (["train", "point", "--seed", "-1"], ["--seed -1", "0 to"]),
        (["train", "point", "--seed", str(2**70)], ["--seed", "0 to"]),
        (["train", "point", "--random-mazes", "-1"], ["--random-mazes -1", "from 0 to 10000"]),
        (["train", "point", "--random-mazes", "10001"], ["--random-mazes 10001", "from 0 to 10000"]),
        (["train", "turtlebot3", "--random-mazes", "5"], ["--random-mazes is not for the turtlebot3", "leave it out"]),
        (["train", "bob"], ["no robot named 'bob'", "point"]),
        (["train", "point", "--preset", "huge"], ["no preset named 'huge'", "cpu, demo", "paper"]),
        (["train", "point", "--engine", "warp"], ["no engine named 'warp'", "auto, mjx, mujoco"]),
        (["train", "point", "--maze", "atlantis"], ["'atlantis'", "antmaze-large", "hall"]),
        (["train", "point", "--eval-maze", "atlantis"], ["'atlantis'", "antmaze-large", "hall"]),
        (["evaluate", "RUN", "--maze", "atlantis"], ["'atlantis'", "antmaze-large"]),
        (
            ["evaluate", "RUN", "--method", "luck"],
            ["no method named 'luck'", "ct, bc-ct, pt-cql, sac, planner, explorer"],
        ),
        (["evaluate", "RUN", "--engine", "warp"], ["no engine named 'warp'", "auto, mjx, mujoco"]),
        (["evaluate", "RUN", "--episodes", "0"], ["--episodes 0", "from 1"]),
        (["evaluate", "RUN", "--episodes", "-5"], ["--episodes -5", "from 1"]),
        (["evaluate", "RUN", "--episodes", "1000000000"], ["--episodes 1000000000", "to"]),
        (["evaluate", "RUN", "--episodes", "ten"], ["--episodes", "'ten'", "whole number"]),
        (["evaluate", "RUN", "--seed", "-1"], ["--seed -1", "0 to"]),
        (["evaluate", "RUN", "--return-scale", "0"], ["--return-scale 0", "above 0, at most 10"]),
        (["evaluate", "RUN", "--return-scale", "nan"], ["--return-scale nan", "above 0, at most 10"]),
        (["evaluate", "RUN", "--return-scale", "0.5", "--method", "explorer"], ["--return-scale", "--method ct"]),
        (["evaluate", "RUN", "--picture", "nowhere/paths.png"], ["--picture nowhere/paths.png", "folder"]),
        (["evaluate", "RUN", "--picture", "paths.gif"], ["--picture paths.gif", ".png, .svg, .pdf"]),
        (["evaluate", "RUN", "--video", "walk.gif"], ["--video walk.gif", ".mp4"]),
        (["train", "point", "--coordinator", "::1:5", "--processes", "2", "--process", "0"], ["[fd00::1]:1234"]),
        (["evaluate", "zoo:nobody"], ["zoo:nobody", "models: zoo:"]),
        (["evaluate", "nowhere"], ["nowhere: no run folder", "ct-jax train"]),
        (["report", "nowhere"], ["nowhere"]),
    ],
)
def test_bad_arguments_are_error_with_remedy(arguments, words, tiny, tiny_run, capsys):
    line = refused(capsys, *(str(tiny_run.folder) if each == "RUN" else each for each in arguments))
    assert [word for word in words if word not in line] == [], line


def test_error_in_real_process_is_one_line():
    done = shell("-m", "ct_jax.cli", "train", "point", "--preset", "huge", env={"XDG_CACHE_HOME": os.devnull})
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
    assert done.stderr.startswith("error: no preset named 'huge'")


# ------------------------------------------------------------------------------------------------------ the outputs


@pytest.mark.parametrize("option", ["--picture", "--video"])
def test_unwritable_output_is_error_before_evaluation(option, tiny, tiny_run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("ct_jax.pipeline.evaluate", lambda *_, **__: pytest.fail("it was evaluated"))
    ending = {"--picture": "png", "--video": "mp4"}[option]
    folder, file = tmp_path / f"folder.{ending}", tmp_path / "file"
    folder.mkdir()
    file.write_text("mine")
    for wrong in (folder, file / f"x.{ending}", tmp_path / "nowhere" / f"x.{ending}"):
        line = refused(capsys, "evaluate", tiny_run.folder, "--episodes", "2", option, wrong)
        assert line.startswith(f"error: {option} {wrong}: cannot be written (")
    assert sorted(tmp_path.iterdir()) == [file, folder]


@pytest.mark.parametrize("as_json", [True, False])
@pytest.mark.parametrize(("stop", "status"), [(OSError(28, "No space left"), 2), (KeyboardInterrupt(), 130)])
def test_row_is_printed_before_drawing(as_json, stop, status, tiny, tiny_run, tmp_path, monkeypatch, capsys):
    def draw(*_):
        raise stop

    monkeypatch.setattr("ct_jax.report.pictures.write_paths", draw)
    command = ["evaluate", str(tiny_run.folder), "--maze", "antmaze-umaze", "--episodes", "2", "--return-scale", "0.5"]
    assert main([*command, "--picture", str(tmp_path / "p.png"), *["--json"] * as_json]) == status
    out = capsys.readouterr().out
    if as_json:
        assert json.loads(out)["return_scale"] == 0.5
    else:
        assert out.splitlines()[1].split()[:2] == ["antmaze-umaze", "ct"]


def test_row_goes_to_stderr_if_stdout_fails(tiny, tiny_run, monkeypatch, capsys):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(cli, "print_rows", full)
    assert main(["evaluate", str(tiny_run.folder), "--maze", "antmaze-umaze", "--episodes", "2"]) == 2
    *_, row, error = capsys.readouterr().err.splitlines()
    assert json.loads(row)["episodes"] == 2 and error.startswith("error: No space left on device")


def test_commands_leave_no_files_in_working_folder(tiny_run, tmp_path):
    """MuJoCo writes no log file either."""
    nowhere = tmp_path / "here"
    nowhere.mkdir()
    cache = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    for command in (["mazes"], ["report", str(tiny_run.folder)], ["evaluate", "zoo:ant", "--episodes", "1"]):
        assert shell("-m", "ct_jax.cli", *command, cwd=nowhere, env=cache).returncode == 0
        assert list(nowhere.iterdir()) == []


# ------------------------------------------------------------------------------------------------------ the devices


@pytest.mark.parametrize(
    ("variables", "words"),
    [
        ({"JAX_PLATFORMS": "cuda"}, ["JAX_PLATFORMS='cuda'", "set JAX_PLATFORMS=cpu", "jax[cuda13]"]),
        ({"JAX_PLATFORMS": "cupu"}, ["JAX_PLATFORMS='cupu'", "known backends", "set JAX_PLATFORMS=cpu"]),
        ({"JAX_PLATFORMS": "tpu"}, ["JAX_PLATFORMS='tpu'", "set JAX_PLATFORMS=cpu"]),
        ({"JAX_PLATFORMS": "rocm"}, ["JAX_PLATFORMS='rocm'", "set JAX_PLATFORMS=cpu"]),
        ({"XLA_FLAGS": "--nonsense=1"}, ["XLA_FLAGS='--nonsense=1'", "Unknown flag", "unset"]),
        ({"XLA_FLAGS": "nonsense"}, ["XLA_FLAGS='nonsense'", "Could not open file", "unset"]),
        ({"XLA_FLAGS": "--xla_force_host_platform_device_count=many"}, ["XLA_FLAGS=", "value many", "unset"]),
        ({"XLA_FLAGS": "--xla_force_host_platform_device_count=0"}, ["finds no device", "unset XLA_FLAGS"]),
        ({"JAX_ENABLE_X64": "maybe"}, ["'maybe'", "JAX_ENABLE_X64", "correct the variable"]),
    ],
)
def test_failed_start_of_devices_is_error_of_one_line(variables, words):
    try:
        jax.devices(variables.get("JAX_PLATFORMS", "nothing"))
        pytest.skip("this machine has it")
    except RuntimeError:
        pass
    done = shell("-m", "ct_jax.cli", "evaluate", "zoo:point", "--episodes", "1", env=variables)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
    assert done.stderr.startswith("error: ") and [word for word in words if word not in done.stderr] == []


def test_empty_platform_variable_uses_default(tmp_path):
    code = "from ct_jax.cli import prepare_jax; prepare_jax(); import jax; print(len(jax.devices()) > 0)"
    assert shell("-c", code, env={"JAX_PLATFORMS": "", "XLA_FLAGS": ""}, cwd=tmp_path).stdout == "True\n"


# ------------------------------------------------------------------------------------------------------- bad mazes


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"####\n#.#\n####\n", [":2: ", "3 cells", "make all lines equal"]),
        (b"", ["empty"]),
        (b"\n\n", ["empty"]),
        (b"####\n####\n####\n", ["no free cell", "'.'"]),
        (b"####\n#...\n####\n", [":2: ", "column 4", "close"]),
        (b"####\n#x.#\n####\n", [":2: ", "'x'"]),
        (b"####\n#.\xff#\n####\n", [":2: ", "not UTF-8"]),
        (10_000, ["too large", "1024 x 1024"]),
    ],
    ids=["ragged", "empty", "blank", "all-wall", "unclosed", "letter", "not-utf8", "10000x10000"],
)
@pytest.mark.parametrize("command", ["train", "evaluate"])
def test_bad_maze_file_is_error_with_line_and_remedy(command, content, words, tiny, tiny_run, tmp_path, capsys):
    file = tmp_path / "floor.txt"
    if isinstance(content, int):
        with file.open("wb") as opened:
            opened.truncate(content * (content + 1))
    else:
        file.write_bytes(content)
    given = ["train", "point", "--out", tmp_path / "run"] if command == "train" else ["evaluate", tiny_run.folder]
    line = refused(capsys, *given, "--maze", file)
    assert str(file) in line and [word for word in words if word not in line] == [], line
    assert not (tmp_path / "run").exists()


def test_folder_as_maze_is_error(tiny, tmp_path, capsys):
    assert str(tmp_path) in refused(capsys, "train", "point", "--maze", tmp_path)


def test_unreadable_maze_is_error(tiny, tmp_path, monkeypatch, capsys):
    file = tmp_path / "floor.txt"
    file.write_text("###\n#.#\n###\n")

    def denied(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", denied)
    line = refused(capsys, "train", "point", "--maze", file)
    assert str(file) in line and "Permission denied" in line


def test_crlf_and_trailing_blank_lines_are_accepted(tiny, tiny_run, islands, tmp_path, capsys):
    file = tmp_path / "floor.txt"
    file.write_bytes(islands.read_bytes().replace(b"\n", b"\r\n") + b"\r\n\r\n")
    rows = []
    for maze in (islands, file):
        assert main(["evaluate", str(tiny_run.folder), "--maze", str(maze), "--episodes", "4", "--json"]) == 0
        rows.append(json.loads(capsys.readouterr().out) | {"wall_s": 0, "maze": ""})
    assert rows[0] == rows[1]


# ----------------------------------------------------------------------------------------------------- bad folders


def test_out_must_be_usable_folder(tiny, tmp_path, capsys):
    command = ["train", "point", "--preset", "tiny", "--maze", "antmaze-umaze", "--out"]
    file, other = tmp_path / "file", tmp_path / "other"
    file.write_text("mine")
    other.mkdir()
    (other / "thesis.tex").write_text("mine")
    for out, word in ((file, "a file"), (file / "below", "Not a directory"), (other, "not empty and no run folder")):
        line = refused(capsys, *command, out)
        assert str(out) in line and word in line and "--out" in line
    assert [path.name for path in other.iterdir()] == ["thesis.tex"]


def test_existing_run_needs_resume(tiny, tiny_run, capsys):
    out = ["--out", tiny_run.folder]
    assert "--resume" in refused(capsys, *tiny_run.arguments, *out)
    assert "seed 0, not 5" in refused(capsys, *tiny_run.arguments, *out, "--resume", "--seed", "5")
    other = ["train", "point", "--preset", "tiny", "--maze", "hall", *out, "--resume"]
    assert "mazes islands, not hall" in refused(capsys, *other)


def test_unfinished_run_has_no_model(tiny, tiny_run, tmp_path, capsys):
    folder = shutil.copytree(tiny_run.folder, tmp_path / "run")
    shutil.rmtree(folder / "model")
    line = refused(capsys, "evaluate", folder)
    assert "not trained to the end" in line and f"--out {folder} --resume" in line


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda text: text[: len(text) // 2], "not JSON"),
        (lambda text: "[]", "not a JSON object"),
        (lambda text: "{}", "of format None"),
        (lambda text: text.replace('"point"', '"bob"'), "no robot named 'bob'"),
        (lambda text: text.replace('"layers"', '"lawyers"'), "another version"),
    ],
)
def test_damaged_model_is_error_with_remedy(change, word, tiny, tiny_run, tmp_path, capsys):
    folder = shutil.copytree(tiny_run.folder, tmp_path / "run")
    file = folder / "model" / "model.json"
    file.write_text(change(file.read_text()))
    line = refused(capsys, "evaluate", folder)
    assert str(file) in line and word in line and "delete" in line


def test_full_disk_is_error_of_one_line_and_keeps_files(tiny, tiny_run, tmp_path, monkeypatch, capsys):
    folder = shutil.copytree(tiny_run.folder, tmp_path / "run")
    (folder / "evaluate" / "done.json").unlink()
    (folder / "evaluate" / "islands-ct.json").unlink()

    def full(file, **arrays):
        raise OSError(errno.ENOSPC, "No space left on device", str(file))

    command = [*tiny_run.arguments, "--out", str(folder), "--resume"]
    with monkeypatch.context() as patch:
        patch.setattr(np, "savez_compressed", full)
        capsys.readouterr()
        assert main(command) == 2
    err = capsys.readouterr().err
    assert err.splitlines()[-1].startswith("error: ") and "No space left" in err and "Traceback" not in err
    assert main(command) == 0


# ---------------------------------------------------------------------------------------------------- interruption


def test_ctrl_c_gives_status_130_and_one_line(monkeypatch, capsys):
    def stop(command):
        raise KeyboardInterrupt

    for name in ("_mazes", "_train"):
        monkeypatch.setattr(cli, name, stop)
    assert main(["mazes"]) == cli.INTERRUPTED == 130
    assert main(["train", "point", "--out", "runs/my run"]) == 130
    out, err = capsys.readouterr()
    assert out == "" and err.splitlines()[0] == "stopped; run it again"
    assert err.splitlines()[1].endswith("continue with: ct-jax train point --out 'runs/my run' --resume")


def test_closed_pipe_is_not_an_error():
    code = "import sys; from ct_jax.cli import main; sys.exit(main(['mazes']))"
    paths = os.pathsep.join([str(ROOT), str(ROOT / "envs")])
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-c", code], stdout=writer, stderr=subprocess.PIPE, env=os.environ | {"PYTHONPATH": paths}
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("command", [["train", "point"], ["evaluate", "zoo:point"]])
@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--coordinator x:1", "belong together"),
        ("--processes 2 --process 0", "belong together"),
        ("--coordinator x --processes 2 --process 0", "--coordinator x: give HOST:PORT"),
        ("--coordinator x:port --processes 2 --process 0", "--coordinator x:port: give HOST:PORT"),
        ("--coordinator x:1 --processes 2 --process 2", "--process 2: give a number from 0 to 1"),
        ("--coordinator x:1 --processes 0 --process 0", "--processes 0: give 1 or more"),
        ("--cluster --process 0", "leave out --coordinator"),
    ],
)
def test_incomplete_process_options_are_error_of_one_line(capsys, command, options, said):
    assert main([*command, *options.split()]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and said in error and error.count("\n") == 1


def test_interrupted_program_does_not_end_the_next_one(monkeypatch):
    """Only the program that a signal stopped ends at once; another one in the same process ends as usual."""

    def stop():
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "_exit", lambda status: pytest.fail("it ended at once"))
    assert cli.guarded(stop) == cli.INTERRUPTED
    assert cli.guarded(lambda: None) == 0
    with pytest.raises(SystemExit):
        cli.leave(0)
