"""The peer of ``transformer.py`` and ``acting.py``: Hugging Face's Decision Transformer (torch), with our map encoder
and goal embedding as inputs. Importing this module needs torch and transformers."""

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]
from transformers import DecisionTransformerConfig, DecisionTransformerModel  # pyright: ignore

from ct_jax.runtime.run import cores
from ct_jax.transformer import GOAL_SCALE_M, RETURN_DIVISOR, ModelConfig

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
torch.set_num_threads(cores())

Batch = dict[str, torch.Tensor]


class PeerTransformer(nn.Module):
    """The same widths, tokens and inputs as ``ControlTransformer``."""

    def __init__(self, config: ModelConfig, proprio_size: int, action_size: int, steps: int):
        super().__init__()
        self.encode_map = nn.Sequential(
            nn.Conv2d(2, 32, 5, stride=5), nn.ReLU(), nn.Conv2d(32, 64, 3), nn.ReLU(), nn.Flatten(),
            nn.Linear(576, config.width),
        )  # fmt: skip
        self.embed_goal = nn.Linear(6, config.width)
        self.trunk = DecisionTransformerModel(
            DecisionTransformerConfig(
                state_dim=2 * config.width + proprio_size, act_dim=action_size, hidden_size=config.width,
                n_layer=config.layers, n_head=config.heads, n_inner=4 * config.width, activation_function="relu",
                n_positions=3 * steps, max_ep_len=config.max_timestep, action_tanh=False, resid_pdrop=config.dropout,
                embd_pdrop=config.dropout, attn_pdrop=0.0,
            )
        )  # fmt: skip
        self.to(DEVICE)

    def forward(self, batch: Batch) -> torch.Tensor:
        """Actions [B, S, A] for windows of trajectories."""
        goal, maps = batch["goal_relative"], batch["map"].float()
        distance = goal.norm(dim=-1, keepdim=True)
        features = torch.cat([goal / GOAL_SCALE_M, torch.tanh(goal / 2.0), goal / (distance + 0.1)], -1)
        seen = self.encode_map(maps.flatten(0, 1)).unflatten(0, maps.shape[:2])
        return self.trunk(
            states=torch.cat([seen, batch["proprio"], self.embed_goal(features)], -1), actions=batch["action"],
            returns_to_go=batch["rtg"][..., None] / RETURN_DIVISOR, timesteps=batch["timestep"],
            attention_mask=batch["valid"],
        ).action_preds  # fmt: skip


def batch_of(**arrays: np.ndarray) -> Batch:
    """Arrays as tensors on the device."""
    return {name: torch.from_numpy(np.array(array)).to(DEVICE) for name, array in arrays.items()}


class PeerTraining:
    """Training of the peer on one prepared batch, with AdamW and gradient clipping."""

    def __init__(self, model: PeerTransformer, batch: Batch, *, bf16: bool = False):
        self._model, self._batch, self._bf16 = model.train(), batch, bf16
        self._optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4, weight_decay=1e-3)

    def train(self, updates: int) -> None:
        """Run a number of updates."""
        for _ in range(updates):
            with torch.autocast(DEVICE, torch.bfloat16, enabled=self._bf16):
                error = (self._model(self._batch) - self._batch["label"]).float() ** 2
            loss = (error.mean(-1) * self._batch["valid"]).sum() / self._batch["valid"].sum()
            self._optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(self._model.parameters(), 1.0)
            self._optimizer.step()
        finish()


@torch.no_grad()
def act(model: PeerTransformer, batch: Batch) -> torch.Tensor:
    """The last action of each window. The whole window is recomputed, as in Hugging Face's example."""
    action = model.eval()(batch)[:, -1]
    finish()
    return action


def finish() -> None:
    """Wait until the device has finished."""
    if DEVICE == "cuda":
        torch.cuda.synchronize()
