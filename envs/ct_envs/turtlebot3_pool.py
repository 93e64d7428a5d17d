"""Several Turtlebot3 simulations in parallel, in worker processes with their own PyBullet clients.

All slots are stepped together. An episode depends only on its world, start, goal, seed and actions, so the number of
processes does not affect the results. If a process dies, a new process replaces it, and repeats the actions of its
episodes up to the current step. The results do not change; it only takes time. A slot takes 9 MB of memory, and a
process takes another 70 MB.

Processes are spawned, so a script that makes a pool needs ``if __name__ == "__main__":``.
"""

import multiprocessing
import os
import signal
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

import numpy as np

from ct_envs.errors import UserError
from ct_envs.lidar import LIDAR_BEAMS, MAP_CELLS
from ct_envs.memory import zeros_given_back
from ct_envs.turtlebot3 import Turtlebot3Config, Turtlebot3Env, load_pybullet
from ct_envs.turtlebot3_world import World

MAX_DEATHS = 5  # the pool gives up after this number of deaths of one process in one step


@dataclass(frozen=True)
class Episode:
    """The initial conditions of an episode."""

    world: World
    start: np.ndarray  # [2], [m]
    goal: np.ndarray  # [2], [m]
    seed: int = 0
    yaw_rad: float | None = None  # if None, it is drawn with the seed


class PoolFrame(NamedTuple):
    """The observation and the state after a step; in a batch with a leading axis N."""

    map: np.ndarray  # uint8 [2, 25, 25]
    proprio: np.ndarray  # float32 [2]: cos dpsi, sin dpsi
    goal: np.ndarray  # float32 [2]: vector to the goal [m]
    position: np.ndarray  # float64 [2], in the world [m]
    yaw_rad: np.ndarray  # float64
    believed_position: np.ndarray  # float64 [2], the robot's estimate; equal to ``position`` without noise [m]
    believed_yaw_rad: np.ndarray  # float64
    ranges: np.ndarray  # float32 [360], [m]
    reward: np.ndarray  # float32
    believed_reward: np.ndarray  # float32: the robot's estimate, without the collision penalty
    done: np.ndarray  # bool; the following fields, too
    success: np.ndarray
    collision: np.ndarray
    frontal: np.ndarray
    grazing: np.ndarray


_EMPTY = PoolFrame(
    np.zeros((2, MAP_CELLS, MAP_CELLS), np.uint8), np.zeros(2, np.float32), np.zeros(2, np.float32), np.zeros(2),
    np.zeros(()), np.zeros(2), np.zeros(()), np.zeros(LIDAR_BEAMS, np.float32), np.zeros((), np.float32),
    np.zeros((), np.float32), np.ones((), bool), *[np.zeros((), bool)] * 4,
)  # fmt: skip


class Turtlebot3Pool:
    """N slots, each for one episode at a time. It is a context manager, which ends the processes on exit."""

    def __init__(self, n: int, *, processes: int | None = None, config: Turtlebot3Config = Turtlebot3Config()):
        """
        Args:
            n: number of slots.
            processes: number of processes; the default is the number of cores, but at most n.

        Raises:
            UserError: n or ``processes`` is less than 1; see also ``Turtlebot3Env``.
        """
        processes = min(n, os.cpu_count() or 1) if processes is None else processes
        if min(n, processes) < 1:
            raise UserError(f"a pool of {n} Turtlebot3 in {processes} processes; use at least one of each")
        load_pybullet()  # raise its errors here; in a worker they would look like deaths
        self.n, self.config = n, config
        self._frames = [_EMPTY] * n
        self._logs: dict[int, tuple[Episode, list[np.ndarray]]] = {}  # by slot: the episode and its actions so far
        self._workers: list[_Worker] = []
        self._asking = False
        try:
            for _ in range(min(processes, n)):
                self._workers.append(_start(config))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "Turtlebot3Pool":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pids(self) -> list[int]:
        """The ids of the worker processes."""
        return [worker.process.pid or -1 for worker in self._workers]

    def close(self) -> None:
        """End the processes at once."""
        for worker in self._workers:
            worker.end()
        self._workers = []

    def reset(self, episodes: Sequence[Episode], slots: Sequence[int] | None = None) -> PoolFrame:
        """Start episodes, by default in the first slots; returns the frames of all N slots. An unused slot is done.

        Raises:
            UserError: more episodes than slots; see also ``Turtlebot3Env.reset``. The slots are then empty.
        """
        slots = range(len(episodes)) if slots is None else slots
        if len(episodes) != len(set(slots)) or not set(slots) <= set(range(self.n)):
            raise UserError(f"{len(episodes)} episodes do not fit slots {list(slots)} of a pool of {self.n}")
        for slot in slots:
            self._logs.pop(slot, None)
            self._frames[slot] = _EMPTY
        given = dict(zip(slots, episodes, strict=True))
        frames = self._ask("reset", given)
        self._logs |= {slot: (episode, []) for slot, episode in given.items()}
        return self._keep(frames)

    def step(self, actions: np.ndarray) -> PoolFrame:
        """One control step of all N episodes with actions [N, 2]. Finished episodes do not change.

        Raises:
            UserError: the actions have another shape, or are not finite for an unfinished episode.
        """
        actions = np.asarray(actions, np.float64)
        live = [slot for slot, frame in enumerate(self._frames) if not frame.done]
        if actions.shape != (self.n, 2) or not np.isfinite(actions[live]).all():
            raise UserError(
                f"the pool needs finite actions [{self.n}, 2], not {actions.shape}; give shares of (v, omega)"
            )
        frames = self._ask("step", {slot: actions[slot] for slot in live})
        for slot in live:
            self._logs[slot][1].append(actions[slot])
        return self._keep(frames)

    def _keep(self, frames: dict[int, PoolFrame]) -> PoolFrame:
        for slot, frame in frames.items():
            self._frames[slot] = frame
        return PoolFrame(*(np.stack(leaves) for leaves in zip(*self._frames, strict=True)))

    def _ask(self, command: str, content: dict[int, Any]) -> dict[int, PoolFrame]:
        """Send a command to the workers of the given slots; returns the frames of these slots."""
        if not self._workers:
            raise UserError("the Turtlebot3 pool is closed; make a new one")
        if self._asking:  # after an interrupt or an error, old answers are still in the pipes
            for number in range(len(self._workers)):
                self._replace(number)
        self._asking = True
        requests: dict[int, dict[int, Any]] = {}
        for slot, value in content.items():
            requests.setdefault(slot % len(self._workers), {})[slot] = value
        for number, request in requests.items():
            self._workers[number].send(command, request)
        answers = [self._answer(number, command, request) for number, request in requests.items()]
        self._asking = any(kind != "frames" for kind, _ in answers)  # an error of a replay: one more answer will follow
        for kind, answer in answers:
            if kind != "frames":
                raise (UserError if kind == "error" else RuntimeError)(answer)
        return {slot: frame for _, answer in answers for slot, frame in answer.items()}

    def _answer(self, number: int, command: str, request: dict[int, Any]) -> tuple[str, Any]:
        """A worker's answer, or its successor's if it died."""
        for _ in range(MAX_DEATHS):
            try:
                return self._workers[number].connection.recv()
            except (EOFError, OSError):
                self._replace(number)
                self._workers[number].send(command, request)
        raise UserError(
            f"a Turtlebot3 process died {MAX_DEATHS} times in one step; use fewer slots if {self.n} simulations do not "
            'fit in memory, and put `if __name__ == "__main__":` in the script'
        )

    def _replace(self, number: int) -> None:
        """Start a new worker, which repeats the episodes of the old one."""
        self._workers[number].end()
        self._workers[number] = _start(self.config)
        mine = {slot: log for slot, log in self._logs.items() if slot % len(self._workers) == number}
        self._workers[number].send("replay", mine)


@dataclass(frozen=True)
class _Worker:
    process: BaseProcess
    connection: Connection

    def send(self, command: str, content: dict[int, Any]) -> None:
        with suppress(OSError):  # the worker died: ``_answer`` will notice
            self.connection.send((command, content))

    def end(self) -> None:
        if self.connection.closed:  # it was ended before, and its successor could not be started
            return
        self.connection.close()
        self.process.kill()
        self.process.join()
        self.process.close()


def _start(config: Turtlebot3Config) -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, config), daemon=True, name="turtlebot3")
    with _no_interrupts():  # the worker inherits this, so that Ctrl-C cannot kill it before it ignores SIGINT
        process.start()
    theirs.close()
    return _Worker(process, ours)


@contextmanager
def _no_interrupts() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(connection: Connection, config: Turtlebot3Config) -> None:
    """The loop of a worker: answer requests until the pool is closed. The pool handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    envs: dict[int, Turtlebot3Env] = {}
    while True:
        try:
            command, content = connection.recv()
        except (EOFError, OSError):
            return
        try:
            answer = "frames", _COMMANDS[command](envs, config, content)
        except UserError as error:
            answer = "error", str(error)
        except Exception:
            answer = "crash", traceback.format_exc()
        try:
            if command != "replay" or answer[0] != "frames":
                connection.send(answer)
        except OSError:
            return


def _reset(
    envs: dict[int, Turtlebot3Env], config: Turtlebot3Config, episodes: dict[int, Episode]
) -> dict[int, PoolFrame]:
    frames = {}
    for slot, episode in episodes.items():
        if slot not in envs:
            with zeros_given_back():  # no other thread of this process is active
                envs[slot] = Turtlebot3Env(config)
        env = envs[slot]
        obs = env.reset(episode.world, episode.start, episode.goal, seed=episode.seed, yaw_rad=episode.yaw_rad)
        frames[slot] = _frame(obs, 0.0, False, env.sight())
    return frames


def _step(envs: dict[int, Turtlebot3Env], _: Turtlebot3Config, actions: dict[int, np.ndarray]) -> dict[int, PoolFrame]:
    return {slot: _frame(*envs[slot].step(action)) for slot, action in actions.items()}


def _replay(
    envs: dict[int, Turtlebot3Env], config: Turtlebot3Config, logs: dict[int, tuple[Episode, list[np.ndarray]]]
) -> dict[int, PoolFrame]:
    _reset(envs, config, {slot: episode for slot, (episode, _) in logs.items()})
    for slot, (_, actions) in logs.items():
        for action in actions:
            envs[slot].step(action)
    return {}


_COMMANDS = {"reset": _reset, "step": _step, "replay": _replay}


def _frame(obs: dict[str, np.ndarray], reward: float, done: bool, info: dict[str, Any]) -> PoolFrame:
    flags = [np.asarray(info.get(name, False)) for name in ("success", "collision", "frontal", "grazing")]
    return PoolFrame(
        obs["map"], obs["proprio"], obs["goal"], info["position"], np.asarray(info["yaw_rad"]),
        info["believed"].position, np.asarray(info["believed"].yaw_rad),
        info["ranges"].astype(np.float32), np.float32(reward), np.float32(info.get("believed_reward", 0.0)),
        np.asarray(done), *flags,
    )  # fmt: skip
