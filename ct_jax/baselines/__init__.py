"""What the transformer is compared with: offline and online reinforcement learning (paper, sec. IV-A)."""
