"""The baselines of the transformer: offline and online reinforcement learning (paper, sec. IV-A)."""
