"""Progress of a stage: a bar with the remaining time, metrics.jsonl, and TensorBoard."""

import json
import math
import secrets
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.summary import scalar

from ct_jax.runtime.devices import is_first
from ct_jax.runtime.files import append_to, make_folder
from ct_jax.runtime.interrupts import raise_if_interrupted
from ct_jax.runtime.terminal import one_line

PLAIN_EVERY_S = 15.0  # without a terminal, interval of progress lines


class Bar:
    """Progress of one stage on stderr: a live bar on a terminal, otherwise lines. Only process 0 shows it."""

    def __init__(self, name: str, total: int, *, console: Console | None = None):
        """
        Args:
            console: output; the default is stderr.
        """
        self.name, self.total = one_line(name), total
        self._begun = self._spoke = time.monotonic()
        self._first: int | None = None
        console = console or Console(stderr=True)
        self._live, self._tells = None, is_first()
        if console.is_terminal and self._tells:
            self._live = Progress(
                TextColumn("{task.description:<12}", markup=False), BarColumn(), MofNCompleteColumn(),
                TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"),
                console=console,
            )  # fmt: skip
            self._task = self._live.add_task(self.name, total=total, note="")

    def __enter__(self) -> "Bar":
        if self._live:
            self._live.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._live:
            self._live.stop()
        elif error is None:
            self._say(f"done in {time.monotonic() - self._begun:.0f} s")

    def update(self, done: int, note: str = "") -> None:
        """Show ``done`` of ``total``, and a short note. Raises ``KeyboardInterrupt`` if a signal is pending."""
        done = min(done, self.total)
        if self._live:
            self._live.update(self._task, completed=done, note=note)
        elif time.monotonic() - self._spoke >= PLAIN_EVERY_S:
            self._spoke = time.monotonic()
            self._say(f"{done}/{self.total}{self._left(done)} {note}".rstrip())
        if self._first is None:
            self._first, self._begun_at = done, time.monotonic()
        raise_if_interrupted()

    def _left(self, done: int) -> str:
        """The remaining time, from the speed since the first update. A resumed stage does not start at zero."""
        if self._first is None or done <= self._first:
            return ""
        left = (time.monotonic() - self._begun_at) * (self.total - done) / (done - self._first)
        return f", {left:.0f} s left"

    def _say(self, text: str) -> None:
        if self._tells:
            with suppress(OSError):  # the work continues if stderr is closed, or is a log on a full disk
                print(f"{self.name}: {text}", file=sys.stderr, flush=True)


class Metrics:
    """Scalars of a run, appended to ``metrics.jsonl`` and to TensorBoard's files in ``tensorboard/``.

    Both are written immediately. TensorBoard's usual writer has its own thread, which hangs if the disk is full. Only
    process 0 writes.
    """

    def __init__(self, run: Path):
        self._writes = is_first()
        if not self._writes:
            return
        board = run / "tensorboard"
        make_folder(board)
        self._file = append_to(run / "metrics.jsonl")
        _drop_half_line(self._file)
        # The writer follows links. A random name ensures that no link has this name.
        self._board = EventsWriter(str(board / "events"), f".{secrets.token_hex(8)}")
        self._begun = time.monotonic()

    def log(self, stage: str, step: int, **values: float) -> None:
        """Log the scalars of a stage at a step. Values that are not finite become null: JSON has none."""
        if not self._writes:
            return
        record: dict[str, str | float | None] = {"stage": stage, "step": step}
        record["time_s"] = round(time.monotonic() - self._begun, 3)
        finite = {name: value for name, value in values.items() if math.isfinite(value)}
        self._file.write(json.dumps(record | dict.fromkeys(values) | finite).encode() + b"\n")
        self._file.flush()
        for name, value in finite.items():
            summary = scalar(f"{stage}/{name}", value)
            self._board.write_event(Event(wall_time=time.time(), step=step, summary=summary))
        self._board.flush()

    def close(self) -> None:
        """Close both files."""
        if not self._writes:
            return
        try:
            self._file.close()
        finally:
            self._board.close()


def _drop_half_line(file: BinaryIO) -> None:
    """Remove an incomplete last line, which a killed process may have left."""
    file.truncate(file.read().rfind(b"\n") + 1)
