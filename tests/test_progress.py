"""Progress and logs: output with and without a terminal, and log files that stay readable."""

import contextlib
import io
import json
import math
from pathlib import Path

import pytest
from rich.console import Console

from ct_jax.runtime import progress
from ct_jax.runtime.interrupts import interruptible
from ct_jax.runtime.progress import Bar, Metrics


def test_terminal_shows_bar_with_remaining_time():
    screen = io.StringIO()
    with Bar("fit", 10, console=Console(file=screen, force_terminal=True, width=120)) as bar:
        for done in (1, 5, 10):
            bar.update(done, f"loss {1 / done:.2f}")
    assert "fit" in screen.getvalue() and "10/10" in screen.getvalue()
    assert "left" in screen.getvalue() and "loss 0.10" in screen.getvalue()


def test_without_terminal_lines_are_printed_at_intervals(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with Bar("fit", 100) as bar:
        for done in range(60, 101):  # resumed at 60: the first 60 took no time in this process
            bar.update(done, "loss 0.5")
            now[0] += 1.0
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == "" and "\x1b" not in err
    assert lines == ["fit: 75/100, 25 s left loss 0.5", "fit: 90/100, 10 s left loss 0.5", "fit: done in 41 s"]


def test_interrupted_bar_does_not_print_done(capsys):
    with pytest.raises(KeyboardInterrupt), Bar("fit", 10):
        raise KeyboardInterrupt
    assert "done" not in capsys.readouterr().err


def test_bar_raises_pending_interrupt():
    import os
    import signal

    import jax
    import numpy as np

    def callback(x):
        os.kill(os.getpid(), signal.SIGINT)
        return np.asarray(x)

    with interruptible(), Bar("fit", 2) as bar:
        bar.update(1)
        echo = jax.jit(lambda x: jax.pure_callback(callback, jax.ShapeDtypeStruct((), np.float32), x))
        assert float(echo(2.0)) == 2.0  # the callback does not raise an error of XLA
        with pytest.raises(KeyboardInterrupt):
            bar.update(2)
        bar.update(2)  # it is raised only once


def test_metrics_are_json_lines_and_tensorboard_files(tmp_path):
    metrics = Metrics(tmp_path)
    metrics.log("fit", 20, loss=0.5)
    metrics.log("fit", 40, loss=math.nan, rate=2)
    metrics.close()
    text = (tmp_path / "metrics.jsonl").read_text()
    lines = [json.loads(line, parse_constant=pytest.fail) for line in text.splitlines()]
    assert [(line["stage"], line["step"], line["loss"]) for line in lines] == [("fit", 20, 0.5), ("fit", 40, None)]
    (events,) = (tmp_path / "tensorboard").glob("events.*")
    assert b"fit/loss" in events.read_bytes()


def test_full_disk_is_error_without_hang(tmp_path):
    metrics = Metrics(tmp_path)
    metrics._file.close()
    metrics._file = Path("/dev/full").open("wb")  # noqa: SIM115
    with pytest.raises(OSError, match="No space left"):
        metrics.log("fit", 1, loss=0.5)
    with contextlib.suppress(OSError):
        metrics.close()


def test_metrics_continue_after_incomplete_line(tmp_path):
    file = tmp_path / "metrics.jsonl"
    file.write_text('{"stage": "fit", "step": 1}\n{"stage": "fi')
    metrics = Metrics(tmp_path)
    metrics.log("fit", 2, loss=0.5)
    metrics.close()
    assert [json.loads(line)["step"] for line in file.read_text().splitlines()] == [1, 2]
