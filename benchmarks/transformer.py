"""Training steps/s of the Control Transformer with its map encoder, at the paper's two sizes.

    python benchmarks/transformer.py [--full]

*turtlebot3* is 4 layers of 128, K=5, batch 128; *ant* is 4 layers of 512, K=50, batch 64 (paper, table I). Ours is the
training step in a ``scan``: sample windows from trajectories, compute their maps and the gradient, clip it, AdamW. The
peer is Hugging Face's Decision Transformer in torch (same widths and batch, with a CNN like ours) on one prepared
batch. The third contestant is a matrix product: the ratio is the FLOP/s of our step divided by those of the product.
XLA counts the operations of our step, without the sampling of windows. On a GPU, bfloat16 and cuDNN's attention are
measured, too.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _harness import Contestant, Options, Results, command_line, has_peer

from ct_envs import load_maze, stack_mazes
from ct_envs.robots import get_robot
from ct_jax.configs import get_preset
from ct_jax.fit import Fit, init_params, transformer_loss
from ct_jax.heads import make_head
from ct_jax.learner import train
from ct_jax.model import sizes
from ct_jax.settings import controller_config
from ct_jax.trajectories import Trajectories, Window, sample_windows
from ct_jax.transformer import ControlTransformer

PEER = "Hugging Face, torch"
TRAJECTORIES, STEPS = 256, 256


@dataclass(frozen=True)
class TransformerOptions(Options):
    """Sizes of the benchmark."""

    robots: tuple[str, ...] = ("turtlebot3", "ant")
    """Robots of the models."""
    side: int = 2048
    """Size of the square matrices (4 times as large on an accelerator)."""
    gflop: float = 100.0
    """Minimum work per call [GFLOP] (100 times as much on an accelerator)."""
    preset: str = "paper"
    """Preset of the models."""
    float32: bool = True
    """Also measure float32 on a GPU. A CPU always uses float32."""


def main(options: TransformerOptions) -> None:
    """Run the benchmark."""
    results = Results(__file__, options)
    torch = has_peer("torch", PEER) and has_peer("transformers", PEER)
    on_gpu = jax.default_backend() == "gpu"
    for robot in options.robots:
        if options.float32 or not on_gpu:
            measure(robot, "float32", "xla", torch, options, results)
        if on_gpu:
            # cuDNN needs an even number of tokens.
            for attention in ("xla", "cudnn") if robot == "ant" else ("xla",):
                measure(robot, "bfloat16", attention, torch, options, results)
    results.finish()


def measure(robot: str, dtype: str, attention: str, torch: bool, options: TransformerOptions, results: Results) -> None:
    """The rows of one model."""
    settings = get_preset(options.preset, robot)
    fit, map_cell_m, spec = settings.fit, settings.model.map_cell_m, get_robot(robot)
    size = sizes(robot)[1]
    head = make_head(settings.model, size, controller_config(settings))
    model = ControlTransformer(settings.model, size, head, dtype=jnp.dtype(dtype), attention=attention)
    data = trajectories(robot)
    mazes = stack_mazes([load_maze("antmaze-large")]) if data.map_bits is None else None
    learner = Fit(transformer_loss(model), fit, map_cell_m, spec)
    learner = learner.create(jax.random.key(0), init_params(jax.random.key(1), model, data))
    draw = jax.jit(lambda key: sample_windows(
        key, data, data.rtg, mazes, batch=fit.batch, steps=fit.steps, map_cell_m=map_cell_m))  # fmt: skip
    window = draw(jax.random.key(2))
    # Count the operations with plain attention, because XLA does not count those inside cuDNN.
    plain = ControlTransformer(settings.model, size, head)
    step_flop = flop(plain, learner.params, window)
    accelerator = jax.default_backend() != "cpu"
    updates = max(1, int((100 if accelerator else 1) * options.gflop * 1e9 / step_flop))
    ours = Contestant(lambda: train(learner, updates, data, data.rtg, mazes), updates)
    product = f"{dtype} matrix product"
    others = {product: matrix_product(options.side * (4 if accelerator else 1), dtype, step_flop)}
    if torch:
        others[PEER] = peer(settings.model, window, updates, bf16=dtype == "bfloat16")
    asked = {PEER: 1.2} if not accelerator else {product: 0.4} if dtype == "bfloat16" and robot == "ant" else {}
    name = f"{robot}, {dtype}" + (", cuDNN attention" if attention == "cudnn" else "")
    times = results.race(name, "steps/s", ours, others, asked=asked)
    results.add(name, "GFLOP/s", [updates * step_flop / 1e9 / t for t in times])


def trajectories(robot: str, n: int = TRAJECTORIES, steps: int = STEPS) -> Trajectories:
    """Random trajectories with the robot's sizes. Those of a robot in rooms contain maps."""
    proprio, action = sizes(robot)
    keys = iter(jax.random.split(jax.random.key(0), 8))
    normal = lambda *more: jax.random.normal(next(keys), (n, steps, *more))  # noqa: E731
    place = lambda *shape: jax.random.uniform(next(keys), (*shape, 2), minval=4.0, maxval=30.0)  # noqa: E731
    seen = {}
    if get_robot(robot).simulator == "pybullet":
        seen = {"goal_relative": normal(2), "map_bits": jax.random.bits(next(keys), (n, steps, 157), jnp.uint8)}
    return Trajectories(
        position=place(n, steps), proprio=normal(proprio),
        action=jnp.tanh(normal(action)), label=jnp.tanh(normal(action)), reward=-jnp.abs(normal()),
        label_mask=jnp.ones((n, steps)), collision=jnp.zeros((n, steps)), goal_world=place(n),
        maze=jnp.zeros(n, jnp.int32), length=jnp.full(n, steps, jnp.int32), **seen,
    )  # fmt: skip


def flop(model: ControlTransformer, params: Any, window: Window) -> float:
    """Floating-point operations of one gradient of the loss. XLA counts them for a CPU, but not for a GPU."""
    gradient = jax.jit(jax.grad(transformer_loss(model)))
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (params, window, jax.random.key(0)))
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        return float(gradient.lower(*shapes).cost_analysis()["flops"])  # pyright: ignore


def matrix_product(side: int, dtype: str, step_flop: float) -> Contestant:
    """Products of square matrices. The unit of work is the number of operations of a training step."""
    a = jax.random.normal(jax.random.key(0), (side, side), jnp.dtype(dtype))
    multiply = jax.jit(lambda a: jax.lax.fori_loop(0, 4, lambda _, b: (a @ b) / side**0.5, a))
    return Contestant(lambda: multiply(a), 4 * 2.0 * side**3 / step_flop)


def peer(config: Any, window: Window, updates: int, *, bf16: bool) -> Contestant:
    """The peer's training on this window."""
    from _decision_transformer import PeerTraining, PeerTransformer, batch_of

    names = ("map", "proprio", "goal_relative", "action", "label", "rtg", "timestep", "valid")
    batch = batch_of(**{name: np.asarray(getattr(window, name)) for name in names})
    batch["timestep"] = batch["timestep"].long()
    sizes = (window.proprio.shape[-1], window.action.shape[-1], window.rtg.shape[1])
    training = PeerTraining(PeerTransformer(config, *sizes), batch, bf16=bf16)
    return Contestant(lambda: training.train(updates), updates, compiles=False)


if __name__ == "__main__":
    command_line(main, TransformerOptions, __doc__)
