"""One acting step of a transformer in many environments: key/value cache compared with recomputing the window.

    python benchmarks/acting.py [--full]

Ours computes the three new tokens, which attend to a full window of cached keys and values. Recomputing computes all 3
K tokens again. Hugging Face's Decision Transformer acts in this way (torch; same widths, with a CNN like ours). ``cpu``
and ``paper`` are the models of these presets. Sizes with a cache larger than ``--memory-gb`` are left out. Contestants
that recompute are left out if the number of environments times K is larger than ``--recompute-steps``.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _harness import Contestant, Options, Results, command_line, has_peer

from ct_jax.configs import get_preset
from ct_jax.transformer import ControlTransformer, ModelConfig, empty_cache, sample_inputs

PROPRIO, ACTION = 27, 8  # the ant's
RECOMPUTED = "recomputing the window"
PEER = "Hugging Face, torch"


@dataclass(frozen=True)
class ActingOptions(Options):
    """Sizes of the benchmark."""

    presets: tuple[str, ...] = ("cpu", "paper")
    """Presets of the models."""
    envs: tuple[int, ...] = (1, 100, 4096)
    """Numbers of environments."""
    contexts: tuple[int, ...] = (5, 50, 200)
    """Values of K."""
    memory_gb: float = 6.0
    """Maximum size of the cache [GB]."""
    recompute_steps: int = 20_500
    """Maximum of the number of environments times K for recomputing."""


def main(options: ActingOptions) -> None:
    """Run the benchmark."""
    results = Results(__file__, options)
    torch = has_peer("torch", PEER) and has_peer("transformers", PEER)
    for preset in options.presets:
        config = get_preset(preset).model
        # The weights are the same for every number of environments and every K.
        params = jax.jit(ControlTransformer(config, ACTION).init)(jax.random.key(0), *sample_inputs(PROPRIO, ACTION))
        for n in options.envs:
            for context in options.contexts:
                # Of the paper's model, measure only its own K at 100 environments, unless --full is given.
                if preset != "paper" or options.full or (n == 100 and context == max(options.contexts)):
                    measure(preset, params, n, context, torch, options, results)
    results.finish()


def measure(
    preset: str, params: Any, n: int, context: int, torch: bool, options: ActingOptions, results: Results
) -> None:
    """The rows of one size."""
    config = replace(get_preset(preset).model, context=context, context_acting=context)
    name = f"{preset} model, {n} environments, K={context}"
    gigabytes = 2 * config.layers * n * config.tokens * (context + 1) * config.width * 4 / 1e9
    if gigabytes > options.memory_gb:
        print(f"{name}: a cache of {gigabytes:.0f} GB; not measured (--memory-gb)")
        return
    model = ControlTransformer(config, ACTION)
    steps = 10 if n <= 1000 else 2
    ours = Contestant(cached(model, params, n, steps), steps)
    others = {}
    if n * context <= options.recompute_steps:
        inputs = window(n, context)
        if options.full or preset != "paper":  # a call of the paper's model takes 20 s
            others[RECOMPUTED] = Contestant(recomputed(model, params, inputs))
        if torch:
            others[PEER] = peer(config, inputs)
    asked = {PEER: 100.0} if (preset, n, context) == ("paper", 100, 200) else {}
    results.race(name, "ms", ours, others, asked=asked)


def window(n: int, steps: int) -> dict[str, np.ndarray]:
    """Random observations of n environments in their last steps."""
    rng = np.random.default_rng(0)
    normal = lambda size: rng.normal(size=(n, steps, size)).astype(np.float32)  # noqa: E731
    return {
        "map": (rng.random((n, steps, 2, 25, 25)) < 0.5).astype(np.uint8), "proprio": normal(PROPRIO),
        "goal": normal(2), "action": normal(ACTION), "rtg": np.full((n, steps), -100.0, np.float32),
        "timestep": np.tile(np.arange(steps), (n, 1)), "valid": np.ones((n, steps), np.float32),
    }  # fmt: skip


def cached(model: ControlTransformer, params: Any, n: int, steps: int) -> Callable[[], object]:
    """A number of steps with the cache, as in a rollout: one program, and the cache is updated in place."""
    now = {name: jnp.asarray(array[:, 0]) for name, array in window(n, 1).items()}

    @functools.partial(jax.jit, donate_argnums=1)  # the cache is not copied, as between the steps of a rollout
    def act(params, cache):
        def step(cache, _):
            action, cache = model.apply(
                params, cache, now["map"], now["proprio"], now["goal"], now["rtg"], method="act"
            )  # pyright: ignore
            return cache, action

        return jax.lax.scan(step, cache, length=steps)

    # The window is full: all slots of the ring are in use. Each layer needs its own buffers, because they are donated.
    cache = empty_cache(model.config, ACTION, n).replace(now=jnp.array(2 * model.config.context_acting))
    held = [jax.tree.map(jnp.copy, cache)]

    def go_on() -> object:
        held[0], actions = act(params, held[0])
        return actions

    return go_on


def recomputed(model: ControlTransformer, params: Any, inputs: dict[str, np.ndarray]) -> Callable[[], object]:
    """The last action of a window; the whole window is computed."""
    arrays = {name: jnp.asarray(array) for name, array in inputs.items()}
    arrays["maps"] = arrays.pop("map")
    act = jax.jit(lambda params, arrays: model.apply(params, **arrays)[:, -1])  # pyright: ignore
    return lambda: act(params, arrays)


def peer(config: ModelConfig, inputs: dict[str, np.ndarray]) -> Contestant:
    """The peer, on the same window."""
    from _decision_transformer import PeerTransformer, act, batch_of

    model, batch = PeerTransformer(config, PROPRIO, ACTION, inputs["rtg"].shape[1]), batch_of(**inputs)
    act(model, batch_of(**{name: array[:1] for name, array in inputs.items()}))  # warm up torch
    return Contestant(lambda: act(model, batch), compiles=False)


if __name__ == "__main__":
    command_line(main, ActingOptions, __doc__)
