"""What a person sees and what is logged while a stage runs: a bar with the time left, metrics.jsonl, TensorBoard."""

import json
import sys
import time
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from tensorboardX import SummaryWriter

_PLAIN_EVERY_S = 15.0  # where there is no terminal, a line this often


class Bar:
    """Progress of one stage on stderr: a live bar on a terminal, a line now and then elsewhere."""

    def __init__(self, name: str, total: int):
        self.name, self.total = name, total
        self._begun = self._spoke = time.monotonic()
        console = Console(stderr=True)
        self._live = None
        if console.is_terminal:
            self._live = Progress(
                TextColumn("{task.description:<12}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
                TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[note]}"), console=console,
            )  # fmt: skip
            self._task = self._live.add_task(name, total=total, note="")

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
        """Show ``done`` of ``total``, and a short note."""
        done = min(done, self.total)
        if self._live:
            self._live.update(self._task, completed=done, note=note)
        elif time.monotonic() - self._spoke >= _PLAIN_EVERY_S:
            self._spoke = time.monotonic()
            left = (self._spoke - self._begun) * (self.total - done) / max(done, 1)
            self._say(f"{done}/{self.total}, {left:.0f} s left {note}")

    def _say(self, text: str) -> None:
        print(f"{self.name}: {text}", file=sys.stderr, flush=True)


class Metrics:
    """Scalars of a run, appended to ``metrics.jsonl`` and to TensorBoard's files in ``tensorboard/``."""

    def __init__(self, run: Path):
        self._file = (run / "metrics.jsonl").open("a", encoding="utf-8")
        self._board = SummaryWriter(str(run / "tensorboard"))
        self._begun = time.monotonic()

    def log(self, stage: str, step: int, **values: float) -> None:
        """Log the scalars of a stage at a step."""
        record = {"stage": stage, "step": step, "time_s": round(time.monotonic() - self._begun, 3)}
        self._file.write(json.dumps(record | values) + "\n")
        self._file.flush()
        for name, value in values.items():
            self._board.add_scalar(f"{stage}/{name}", value, step)

    def close(self) -> None:
        self._file.close()
        self._board.close()
