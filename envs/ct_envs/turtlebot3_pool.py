"""Several Turtlebot3 simulations side by side, in worker processes with PyBullet clients of their own.

All slots are stepped together. An episode depends on nothing but its world, start, goal, seed and actions, so the
number of processes changes nothing; and where a process dies, another one takes its place and drives its episodes
again up to where they were: who uses the pool does not notice, but for the time it takes. A slot takes 9 MB, and a
process 70 MB besides.

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

MAX_DEATHS = 5  # of one process, during one step, until the pool gives up


@dataclass(frozen=True)
class Episode:
    """What an episode begins with."""

    world: World
    start: np.ndarray  # [2], [m]
    goal: np.ndarray  # [2], [m]
    seed: int = 0
    yaw_rad: float | None = None  # by default drawn from the seed


class Frame(NamedTuple):
    """What is seen and known after a step; in a batch, with a leading axis N."""

    map: np.ndarray  # uint8 [2, 25, 25]
    proprio: np.ndarray  # float32 [2]: cos dpsi, sin dpsi
    goal: np.ndarray  # float32 [2]: vector to the goal [m]
    position: np.ndarray  # float64 [2], in the world [m]
    yaw_rad: np.ndarray  # float64
    believed_position: np.ndarray  # float64 [2], where the robot believes to be; the truth, without noise [m]
    believed_yaw_rad: np.ndarray  # float64
    ranges: np.ndarray  # float32 [360], [m]
    reward: np.ndarray  # float32
    believed_reward: np.ndarray  # float32: as the robot can tell by itself, which feels no touch
    done: np.ndarray  # bool, as all that follow
    success: np.ndarray
    collision: np.ndarray
    frontal: np.ndarray
    grazing: np.ndarray


_EMPTY = Frame(
    np.zeros((2, MAP_CELLS, MAP_CELLS), np.uint8), np.zeros(2, np.float32), np.zeros(2, np.float32), np.zeros(2),
    np.zeros(()), np.zeros(2), np.zeros(()), np.zeros(LIDAR_BEAMS, np.float32), np.zeros((), np.float32),
    np.zeros((), np.float32), np.ones((), bool), *[np.zeros((), bool)] * 4,
)  # fmt: skip


class Turtlebot3Pool:
    """N slots, each for one episode at a time. A context manager: leaving it ends the processes."""

    def __init__(self, n: int, *, processes: int | None = None, config: Turtlebot3Config = Turtlebot3Config()):
        """
        Args:
            n: slots.
            processes: by default as many as there are cores, and at most n.

        Raises:
            UserError: no slot or process, or what ``Turtlebot3Env`` raises.
        """
        processes = min(n, os.cpu_count() or 1) if processes is None else processes
        if min(n, processes) < 1:
            raise UserError(f"a pool of {n} Turtlebot3 in {processes} processes; use at least one of each")
        load_pybullet()  # its errors are a user's to read; in a process they would be deaths
        self.n, self.config = n, config
        self._frames = [_EMPTY] * n
        self._logs: dict[int, tuple[Episode, list[np.ndarray]]] = {}  # by slot: how to come to where it is
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
        """The worker processes."""
        return [worker.process.pid or -1 for worker in self._workers]

    def close(self) -> None:
        """End the processes, whatever they are at."""
        for worker in self._workers:
            worker.end()
        self._workers = []

    def reset(self, episodes: Sequence[Episode], slots: Sequence[int] | None = None) -> Frame:
        """Begin episodes, by default in the first slots; frames of all N. A slot never begun counts as done.

        Raises:
            UserError: more episodes than slots, or what ``Turtlebot3Env.reset`` raises; these slots are then empty.
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

    def step(self, actions: np.ndarray) -> Frame:
        """One control step of all N episodes with actions [N, 2]; those that are done stay as they are.

        Raises:
            UserError: actions of another shape, or not finite ones for an episode that is not done.
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

    def _keep(self, frames: dict[int, Frame]) -> Frame:
        for slot, frame in frames.items():
            self._frames[slot] = frame
        return Frame(*(np.stack(leaves) for leaves in zip(*self._frames, strict=True)))

    def _ask(self, command: str, content: dict[int, Any]) -> dict[int, Frame]:
        """The frames of the slots asked for, from the workers that have them."""
        if not self._workers:
            raise UserError("the Turtlebot3 pool is closed; make a new one")
        if self._asking:  # an interrupt or an error left answers in the pipes
            for number in range(len(self._workers)):
                self._replace(number)
        self._asking = True
        requests: dict[int, dict[int, Any]] = {}
        for slot, value in content.items():
            requests.setdefault(slot % len(self._workers), {})[slot] = value
        for number, request in requests.items():
            self._workers[number].send(command, request)
        answers = [self._answer(number, command, request) for number, request in requests.items()]
        self._asking = any(kind != "frames" for kind, _ in answers)  # if of what was driven again, one more is to come
        for kind, answer in answers:
            if kind != "frames":
                raise (UserError if kind == "error" else RuntimeError)(answer)
        return {slot: frame for _, answer in answers for slot, frame in answer.items()}

    def _answer(self, number: int, command: str, request: dict[int, Any]) -> tuple[str, Any]:
        """A worker's answer; if it died, its successor's."""
        for _ in range(MAX_DEATHS):
            try:
                return self._workers[number].connection.recv()
            except (EOFError, OSError):
                self._replace(number)
                self._workers[number].send(command, request)
        raise UserError(
            f"a Turtlebot3 process died {MAX_DEATHS} times in one step; is there memory for {self.n} simulations, and "
            'an `if __name__ == "__main__":` in the script? use fewer slots'
        )

    def _replace(self, number: int) -> None:
        """A new worker, with the old one's episodes driven again."""
        self._workers[number].end()
        self._workers[number] = _start(self.config)
        mine = {slot: log for slot, log in self._logs.items() if slot % len(self._workers) == number}
        self._workers[number].send("replay", mine)


@dataclass(frozen=True)
class _Worker:
    process: BaseProcess
    connection: Connection

    def send(self, command: str, content: dict[int, Any]) -> None:
        with suppress(OSError):  # it died: whoever waits for its answer will see
            self.connection.send((command, content))

    def end(self) -> None:
        if self.connection.closed:  # ended before, and no other could be started in its place
            return
        self.connection.close()
        self.process.kill()
        self.process.join()
        self.process.close()


def _start(config: Turtlebot3Config) -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, config), daemon=True, name="turtlebot3")
    with _no_interrupts():  # inherited: a worker must not die of a Ctrl-C before it can ignore it
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
    """A worker's life: answer until the pool is gone. Ctrl-C is the pool's to handle."""
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


def _reset(envs: dict[int, Turtlebot3Env], config: Turtlebot3Config, episodes: dict[int, Episode]) -> dict[int, Frame]:
    frames = {}
    for slot, episode in episodes.items():
        if slot not in envs:
            with zeros_given_back():  # this thread is the process's only one that works
                envs[slot] = Turtlebot3Env(config)
        env = envs[slot]
        obs = env.reset(episode.world, episode.start, episode.goal, seed=episode.seed, yaw_rad=episode.yaw_rad)
        frames[slot] = _frame(obs, 0.0, False, env.sight())
    return frames


def _step(envs: dict[int, Turtlebot3Env], _: Turtlebot3Config, actions: dict[int, np.ndarray]) -> dict[int, Frame]:
    return {slot: _frame(*envs[slot].step(action)) for slot, action in actions.items()}


def _replay(
    envs: dict[int, Turtlebot3Env], config: Turtlebot3Config, logs: dict[int, tuple[Episode, list[np.ndarray]]]
) -> dict[int, Frame]:
    _reset(envs, config, {slot: episode for slot, (episode, _) in logs.items()})
    for slot, (_, actions) in logs.items():
        for action in actions:
            envs[slot].step(action)
    return {}


_COMMANDS = {"reset": _reset, "step": _step, "replay": _replay}


def _frame(obs: dict[str, np.ndarray], reward: float, done: bool, info: dict[str, Any]) -> Frame:
    flags = [np.asarray(info.get(name, False)) for name in ("success", "collision", "frontal", "grazing")]
    return Frame(
        obs["map"], obs["proprio"], obs["goal"], info["position"], np.asarray(info["yaw_rad"]),
        info["believed"].position, np.asarray(info["believed"].yaw_rad),
        info["ranges"].astype(np.float32), np.float32(reward), np.float32(info.get("believed_reward", 0.0)),
        np.asarray(done), *flags,
    )  # fmt: skip
