"""Control Transformer in JAX: robot navigation in unknown mazes, learned from roadmap-guided trajectories."""

__version__ = "0.1.0"
