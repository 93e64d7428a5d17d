"""Time to build a roadmap and its next-hop table, warm, in ``antmaze-large``; the paper's is 200 samples, 10 m.

python benchmarks/prm.py
"""

import jax
from _table import Results, time_alone

from ct_envs import load_maze
from ct_jax.prm import PrmConfig, build_roadmap


def main() -> None:
    """Run and print."""
    results = Results("prm")
    maze = load_maze("antmaze-large")
    for samples in (200, 1000):
        seeds = iter(range(10**6))

        def build(samples=samples, seeds=seeds):
            key = jax.random.key(next(seeds))
            return build_roadmap(key, maze, radius_m=0.5, config=PrmConfig(samples=samples)).table

        taken = time_alone(build)
        results.add(f"{samples} samples, d = 10 m: build and next-hop table", "ms", [1000 * t for t in taken])
    results.finish()


if __name__ == "__main__":
    main()
