"""One acting step of a transformer for many environments: key/value cache against recomputing the window.

python benchmarks/acting.py [--preset demo] [--envs 100] [--context 50]
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import tyro
from _table import Results, time_pairs

from ct_jax.presets import get_preset
from ct_jax.transformer import ControlTransformer, empty_cache, sample_inputs


@dataclass(frozen=True)
class Options:
    """Sizes of the benchmark."""

    preset: str = "demo"
    """Whose model."""
    envs: int = 100
    """Environments."""
    context: int = 50
    """K."""


def main(options: Options) -> None:
    """Run and print."""
    config = replace(get_preset(options.preset).model, context=options.context, context_acting=options.context)
    model = ControlTransformer(config, 2)
    params = jax.jit(model.init)(jax.random.key(0), *sample_inputs(2, 2))
    n, k = options.envs, options.context
    keys = jax.random.split(jax.random.key(1), 4)
    maps = jax.random.bernoulli(keys[0], 0.5, (n, k, 2, 25, 25)).astype(jnp.float32)
    proprio, goal, action = (jax.random.normal(key, (n, k, 2)) for key in keys[1:])
    rtg, valid = -100.0 * jnp.ones((n, k)), jnp.ones((n, k))
    timestep = jnp.broadcast_to(jnp.arange(k), (n, k))

    @jax.jit
    def recompute(params):
        return model.apply(params, maps, proprio, goal, action, rtg, timestep, valid)[:, -1]  # pyright: ignore

    @jax.jit
    def act(params, cache):
        return model.apply(params, cache, maps[:, 0], proprio[:, 0], goal[:, 0], rtg[:, 0], method="act")

    # a full window: every place of the ring is in use
    cache = empty_cache(config, 2, n).replace(now=jnp.array(2 * k))
    ours, other = time_pairs(lambda: act(params, cache), lambda: recompute(params))
    results = Results("acting")
    ratios = [b / a for a, b in zip(ours, other, strict=True)]
    what = f"{options.preset} model, {n} environments, K={k}: one step"
    results.add(what, "ms", [1000 * t for t in ours], against="recomputing the window", ratios=ratios)
    results.finish()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
