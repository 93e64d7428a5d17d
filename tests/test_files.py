"""Writing files: complete or not at all, not through links, and with the permissions of the umask."""

import functools
import os
import resource
import shutil
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ct_envs import UserError
from ct_envs.maze import load_walls
from ct_jax import trajectories
from ct_jax.cli import main
from ct_jax.runtime.checkpoint import Checkpoints, save_weights, write_json
from ct_jax.runtime.files import append_to, check_writable, drop_parts, make_folder, save_arrays, whole, write_text
from ct_jax.runtime.progress import Metrics

CONTENT = np.random.default_rng(0).random(20_000)  # it cannot be compressed


@contextmanager
def no_room(most: int = 1000):
    """A limit of the file size, which stands for a full disk. The system's error differs only in its number."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def umask(mask: int):
    before = os.umask(mask)
    try:
        yield
    finally:
        os.umask(before)


def picture(file: Path) -> None:
    from ct_jax.report import pictures

    path = np.full((3, 1, 2), 6.0)
    pairs = SimpleNamespace(start=path[0], goal=path[0] + 4)
    episodes = SimpleNamespace(pairs=pairs, path=path, steps=np.full(1, 3), success=np.zeros(1, bool))
    pictures.write_paths(file, load_walls("antmaze-umaze"), episodes, "a picture")


WRITERS = {
    "text": lambda file: write_text(file, str(CONTENT.tolist())),
    "json": lambda file: write_json(file, CONTENT.tolist()),
    "arrays": lambda file: save_arrays(file, content=CONTENT),
    "weights": lambda file: save_weights(file, {"layer": CONTENT}),
    "picture.png": picture,
}


@pytest.fixture(params=WRITERS)
def writer(request, tmp_path):
    """A file in its own folder, and a function that writes it."""
    (tmp_path / "inside").mkdir()
    return tmp_path / "inside" / request.param, functools.partial(WRITERS[request.param])


# --------------------------------------------------------------------------------------------------- one file


@pytest.mark.parametrize("mask", [0o022, 0o002, 0o077])
def test_umask_sets_permissions(writer, mask):
    file, write = writer
    with umask(mask):
        write(file)
    assert file.stat().st_mode & 0o777 == 0o666 & ~mask


def test_failed_write_changes_nothing(writer):
    file, write = writer
    for before in ([], [file]):
        with no_room(), pytest.raises(UserError, match=rf"^{file}: cannot be written \(.*; what is finished is kept$"):
            write(file)
        assert list(file.parent.iterdir()) == before
        file.write_bytes(b"before")
    assert file.read_bytes() == b"before"


def test_link_is_replaced_and_its_target_is_kept(writer):
    file, write = writer
    for victim in (file.parents[1] / "victim", file.parents[1] / "none"):
        if victim.name == "victim":
            victim.write_text("mine")
        file.unlink(missing_ok=True)
        file.symlink_to(victim)
        write(file)
        assert not file.is_symlink() and file.stat().st_size > 1000
    assert (file.parents[1] / "victim").read_text() == "mine" and not (file.parents[1] / "none").exists()


@pytest.mark.parametrize("stop", [KeyboardInterrupt, RuntimeError])
def test_interrupted_write_changes_nothing(tmp_path, stop):
    file = tmp_path / "file"
    file.write_text("before")
    with pytest.raises(stop), whole(file) as opened:
        opened.write(b"half")
        raise stop
    assert file.read_text() == "before" and list(tmp_path.iterdir()) == [file]


def test_only_unfinished_files_are_deleted(tmp_path):
    (tmp_path / "stage").mkdir()
    kept = tmp_path / "stage" / "lamp.part"
    kept.write_text("mine")
    with suppress(RuntimeError), whole(tmp_path / "stage" / "file") as opened:
        left = shutil.copy(opened.name, tmp_path / "copy")
        name = Path(opened.name).name
        raise RuntimeError
    shutil.move(left, tmp_path / "stage" / name)
    drop_parts(tmp_path)
    assert list((tmp_path / "stage").iterdir()) == [kept]


@pytest.mark.parametrize("open_it", [append_to, lambda file: make_folder(file)])
def test_append_to_link_is_error(tmp_path, open_it):
    victim = tmp_path / "victim"
    link = tmp_path / "link"
    link.symlink_to(victim)
    for make in (lambda: None, victim.mkdir):
        make()
        with pytest.raises(UserError, match=f"^{link}: a link; delete it"):
            open_it(link)
    assert list(victim.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("folder", "cannot be written .Is a directory.*; choose another place"),
        ("nowhere/file", "cannot be written .No such file.*; give a folder that exists"),
        ("file/below", "cannot be written .Not a directory.*; give a folder that exists"),
    ],
)
def test_unwritable_file_is_error_before_work(tmp_path, name, said):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match=rf"^--picture {tmp_path / name}: {said}"):
        check_writable(tmp_path / "file", tmp_path / name, option="--picture")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_check_writable_changes_nothing(tmp_path):
    file = tmp_path / "file"
    for content in (None, "mine"):
        if content:
            file.write_text(content)
        check_writable(file)
        assert [path.read_text() for path in tmp_path.iterdir()] == ([content] if content else [])
    with no_room(), pytest.raises(UserError, match="cannot be written"):
        check_writable(file)
    assert file.read_text() == "mine" and list(tmp_path.iterdir()) == [file]


# --------------------------------------------------------------------------------------------------- a run


def test_umask_sets_permissions_of_checkpoints_and_logs(tmp_path, toy_data):
    with umask(0o027):
        checkpoints, metrics = Checkpoints(tmp_path / "checkpoints"), Metrics(tmp_path)
        checkpoints.save(1, {"a": np.ones(3)})
        checkpoints.close()
        metrics.log("fit", 1, loss=1.0)
        metrics.close()
        trajectories.save(toy_data([3, 4]), tmp_path / "data.npz")
    assert {path.stat().st_mode & 0o777 for path in tmp_path.rglob("*") if path.is_file()} == {0o640}
    assert {path.stat().st_mode & 0o777 for path in tmp_path.rglob("*") if path.is_dir()} == {0o750}


@pytest.mark.rank_promotion("allow")
def test_files_of_run_have_same_permissions(tiny_run):
    mask = os.umask(0)
    os.umask(mask)
    files = [path for path in tiny_run.folder.rglob("*") if path.is_file()]
    assert len(files) > 30 and {path.stat().st_mode & 0o777 for path in files} == {0o666 & ~mask}
    assert not [path for path in files if path.suffix == ".part"]


@pytest.mark.rank_promotion("allow")
@pytest.mark.slow
def test_links_in_run_folder_are_not_followed(tiny, tiny_run, tmp_path):
    """There is a link in the place of each file that the run will write."""
    folder, outside = tmp_path / "run", tmp_path / "outside"
    outside.mkdir()
    appended = {"config.json", "metrics.jsonl", "run.lock"}
    for path in sorted(tiny_run.folder.rglob("*")):
        link = folder / path.relative_to(tiny_run.folder)
        if path.is_dir():
            link.mkdir(parents=True)
        elif path.name not in appended and path.parent.name != "tensorboard":
            link.symlink_to(outside / str(path.relative_to(tiny_run.folder)).replace("/", "-"))
    shutil.copy(tiny_run.folder / "config.json", folder)
    assert main([*tiny_run.arguments, "--out", str(folder), "--resume"]) == 0
    assert list(outside.iterdir()) == []
    assert not [path for path in folder.rglob("*") if path.is_symlink()]


@pytest.mark.rank_promotion("allow")
@pytest.mark.parametrize("name", ["metrics.jsonl", "run.lock", "evaluate", "tensorboard", "model"])
def test_link_to_folder_in_run_is_error(name, tiny, tiny_run, tmp_path, capsys):
    folder = shutil.copytree(tiny_run.folder, tmp_path / "run")
    victim = (folder / name).rename(tmp_path / "victim")
    (folder / name).symlink_to(victim)
    (folder / "report.html").unlink()
    before = victim.read_bytes() if victim.is_file() else sorted(victim.iterdir())
    assert main([*tiny_run.arguments, "--out", str(folder), "--resume"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and err.startswith(f"error: {folder / name}: a link")
    assert before == (victim.read_bytes() if victim.is_file() else sorted(victim.iterdir()))


@pytest.mark.rank_promotion("allow")
def test_report_does_not_follow_links(tiny_run, tmp_path, capsys):
    folder, victim = shutil.copytree(tiny_run.folder, tmp_path / "run"), tmp_path / "victim"
    victim.write_text("mine")
    for name in ("report.html", "report.png"):
        (folder / name).unlink()
        (folder / name).symlink_to(victim)
    assert main(["report", str(folder)]) == 0
    assert victim.read_text() == "mine" and (folder / "report.html").stat().st_size > 10_000


@pytest.mark.rank_promotion("allow")
def test_unwritable_report_is_error_before_drawing(tiny_run, tmp_path, monkeypatch, capsys):
    folder = shutil.copytree(tiny_run.folder, tmp_path / "run")
    (folder / "report.png").unlink()
    (folder / "report.png").mkdir()
    monkeypatch.setattr("ct_jax.report.page", lambda run: pytest.fail("it was drawn"))
    assert main(["report", str(folder)]) == 2
    assert f"{folder / 'report.png'}: cannot be written (Is a directory)" in capsys.readouterr().err
