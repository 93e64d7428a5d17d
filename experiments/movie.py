"""Make the animation in README.md: a film of one episode beside the map of its maze.

    python experiments/movie.py --run zoo:ant --maze antmaze-large-eval --seed 2 --out docs/ant.gif

The map is for the reader: the model observes 25 x 25 cells around the robot, and the vector to its goal. Needs the
package ``av`` and OpenGL without a display, as ``ct-jax evaluate --video`` does.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image, ImageDraw
from rows import CT

from ct_envs import Maze, MazeEnv, UserError, load_maze
from ct_envs.maze import unpadded
from ct_jax.cli import guarded, leave, prepare_jax
from ct_jax.evaluate import evaluate
from ct_jax.model import load_model
from ct_jax.report.video import check_video, write_video
from ct_jax.runtime.files import check_writable, whole
from ct_jax.worlds.maze_runs import as_film
from ct_jax.worlds.mazes import MazeWorld

WALL, FLOOR, PATH, ROBOT, GOAL = "#8d99a6", "#ffffff", "#1b6ca8", "#e07b28", "#ffe000"
COLOURS = 128


@dataclass(frozen=True)
class Options:
    """What to film."""

    run: str = "zoo:ant"
    """A run folder, or a model that ships with the package."""
    maze: str = "antmaze-large-eval"
    """Maze by name or text file."""
    seed: int = 2
    """Seed of the start and the goal."""
    out: Path = Path("docs/ant.gif")
    """The GIF to write."""
    height: int = 270
    """Height of the picture [pixels]."""
    speed: int = 4
    """Speed of the film relative to real time."""


def frames_of(video: Path, n: int) -> Iterator[Image.Image]:
    """Every n-th picture of a video."""
    import av

    with av.open(str(video)) as container:
        for i, frame in enumerate(container.decode(video=0)):
            if i % n == 0:
                yield frame.to_image()


def draw_map(maze: Maze, path: np.ndarray, goal: np.ndarray, height: int) -> Image.Image:
    """The maze from above with the path so far: positions [n, 2] and goal [2] in metres, x to the right and y up."""
    walls = unpadded(maze)
    scale = height / (walls.shape[0] * float(maze.cell_m))
    side = scale * float(maze.cell_m)
    picture = Image.new("RGB", (round(walls.shape[1] * side), height), FLOOR)
    draw = ImageDraw.Draw(picture)
    at = lambda point: (scale * float(point[0]), height - scale * float(point[1]))  # noqa: E731
    for row, column in np.argwhere(walls):
        top = height - (row + 1) * side
        draw.rectangle((column * side, top, (column + 1) * side, top + side), fill=WALL)
    draw.line([at(point) for point in path], fill=PATH, width=2)
    for point, colour, radius in ((goal, GOAL, 8), (path[-1], ROBOT, 5)):
        x, y = at(point)
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour, outline="#333333")
    return picture


def main(options: Options) -> None:
    """Film one episode. Raises UserError if the model does not reach its goal."""
    if options.out.suffix != ".gif":
        raise UserError(f"--out {options.out}: give a .gif file")
    check_writable(options.out, option="--out")
    prepare_jax()
    model, maze = load_model(options.run), load_maze(options.maze)
    env = MazeEnv(model.robot, map_cell_m=model.settings.model.map_cell_m, auto_reset=False)
    robot, world = env.robot, MazeWorld(env, maze)
    pairs = world.draw_pairs(options.seed, 1)
    episodes = evaluate(world, pairs, CT, policy=model.policy)
    if not episodes.success[0]:
        raise UserError(f"--seed {options.seed}: the robot does not reach this goal; try another seed")
    steps = int(episodes.steps[0])
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "episode.mp4"
        check_video(video)
        write_video(video, robot, maze, as_film(robot.name, episodes), pairs.goal[0], options.run)
        filmed = list(frames_of(video, options.speed))
    path = episodes.path[:steps, 0]
    pictures = []
    for i, frame in enumerate(filmed):
        so_far = path[: max(2, round(steps * (i + 1) / len(filmed)))]
        pictures.append(beside(frame, draw_map(maze, so_far, pairs.goal[0], options.height)))
    ms = round(1000 * steps * robot.control_dt_s / len(filmed) / options.speed)
    durations = [ms] * (len(pictures) - 1) + [2000]  # pause at the end
    more = {"append_images": pictures[1:], "duration": durations, "loop": 0, "optimize": True}
    with whole(options.out) as opened:
        pictures[0].save(opened, "gif", save_all=True, **more)
    print(f"{options.out}: {len(pictures)} pictures, {options.out.stat().st_size / 1e6:.1f} MB")


def beside(film: Image.Image, drawn: Image.Image) -> Image.Image:
    """Two pictures side by side, in few colours."""
    film = film.resize((round(film.width * drawn.height / film.height), drawn.height), Image.Resampling.LANCZOS)
    both = Image.new("RGB", (film.width + 6 + drawn.width, drawn.height), FLOOR)
    both.paste(film, (0, 0))
    both.paste(drawn, (film.width + 6, 0))
    return both.quantize(COLOURS, dither=Image.Dither.NONE)


if __name__ == "__main__":
    leave(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
