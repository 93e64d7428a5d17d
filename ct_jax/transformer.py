"""Control Transformer: a return-conditioned causal transformer (paper, sec. III-D and III-F).

Attention is causal and *banded*: a token of step t attends to tokens of steps t - K + 1 ... t that come before it. With
a ``stride`` of s it attends to steps t, t - s, t - 2s and so on, K of them: s times the memory at the cost of one.

There are two ways to act. With ``acting="window"``, the paper's, each action is computed anew from the last K steps:
this is what training on pieces of K steps computes. With ``acting="cache"`` keys and values of earlier steps are kept.
A kept key has seen K steps of its own, so that L layers reach back L (K - 1) + 1 steps: this is what training on longer
pieces computes.
"""

import functools
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, UInt8

from ct_envs import UserError
from ct_envs.checked import Above, Checked, Within
from ct_envs.frames import FrameName, own_frame, turn
from ct_envs.occupancy import MAP_CELLS
from ct_jax.dense import Dense, Dropout

Attention = Literal["xla", "cudnn"]  # implementations of jax.nn.dot_product_attention
GOAL_SCALE_M = 10.0  # goal vectors are divided by this
RETURN_DIVISOR = 1000.0  # returns are divided by this
SPEED_SCALE = 5.0  # velocities of a body [m/s, rad/s] are divided by this


@dataclass(frozen=True)
class ModelConfig(Checked):
    """Sizes of the transformer (paper, table I)."""

    layers: Annotated[int, Within(1, 64)] = 4  # transformer blocks
    heads: Annotated[int, Within(1, 64)] = 4  # attention heads; the width is a multiple of them
    width: Annotated[int, Within(1, 16_384)] = 128  # embedding dimension
    context: Annotated[int, Within(1, 10_000)] = 50  # K [steps] in training
    context_acting: Annotated[int, Within(1, 10_000)] = 50  # K [steps] when acting
    dropout: Annotated[float, Within(0, 0.99)] = 0.1  # share of activations that training drops
    max_timestep: Annotated[int, Within(1, 1_000_000)] = 1024  # embeddings of the absolute timestep
    map_cell_m: Annotated[float, Above(0, 100)] = 0.8  # side of a cell of the local map [m]
    returns: bool = True  # condition on returns; without them this is BC-CT
    actions: bool = True  # see its own past actions, as the paper's does; without them, it cannot repeat itself
    frame: FrameName = "world"  # the paper's; with "heading" the body is felt, and moved, in the robot's own frame
    # With "heading": planar vectors that the trunk hands to the body, in the world's frame.
    directions: Annotated[int, Within(1, 1024)] = 16
    # Actions to choose from (paper: 1); with one, left or right round an obstacle become straight at it.
    modes: Annotated[int, Within(1, 256)] = 1
    # When acting, keep to the mode chosen before unless another is e^commitment times likelier.
    commitment: Annotated[float, Within(0, 1_000_000)] = 0.0
    skill: bool = False  # the head is the low-level controller, which stays as it is: the trunk tells it where to go
    acting: Literal["cache", "window"] = "cache"  # keep keys and values, or compute the last K steps anew (paper)
    stride: Annotated[int, Within(1, 1000)] = 1  # control steps from one step of the memory to the next (paper: 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width % self.heads:
            raise UserError(f"ModelConfig.width is {self.width}; give a multiple of heads, {self.heads}")
        if self.acting == "window" and (self.stride > 1 or self.commitment > 0):
            raise UserError("ModelConfig.acting 'window' knows neither stride nor commitment; use acting 'cache'")

    @property
    def tokens(self) -> int:
        """Of a step: return-to-go, state and, where it is seen, action."""
        return 3 if self.actions else 2


_NEVER = -(10**6)  # the step of a token that is not there
_FIRST = np.int32(0)  # an index of the type of the others, also where JAX has 64 bits


@struct.dataclass
class Cache:
    """Keys and values of the last steps of N episodes, a ring of K + 1 places for the tokens (a_{t-1},) R_t, s_t.

    One place more than K: the last action still sees K steps back from its own. The places come last, as XLA's matrix
    products on CPU want them: otherwise each step would transpose the whole cache. With a stride of S there are as many
    memories, which take turns: each holds every S-th step, and none knows of the others.
    """

    keys: tuple[Float[Array, "N S H D P"], ...]  # one array a layer
    values: tuple[Float[Array, "N S H D P"], ...]
    step: Int[Array, "S P"]  # step of each token, as its memory counts
    now: Int[Array, ""]  # steps taken, of all memories
    action: Float[Array, "N S A"]  # last action of each memory
    mode: Int[Array, "N"]  # which of the modes it was; -1, which is none of them, before the first


@struct.dataclass
class History:
    """The last K steps of N episodes, the oldest first, from which ``acting="window"`` computes each action anew.

    Before K steps were taken, the places after the present step are empty.
    """

    map: UInt8[Array, "N K 2 k k"]
    proprio: Float[Array, "N K P"]
    goal: Float[Array, "N K 2"]  # from the robot [m]
    action: Float[Array, "N K A"]
    rtg: Float[Array, "N K"]
    now: Int[Array, ""]  # steps taken


class MapEncoder(nn.Module):
    """A small CNN over the local map: a 5 x 5 convolution of stride 5, a 3 x 3 one, and a dense layer.

    The convolutions are written as matrix products over patches: XLA's convolutions are many times slower on CPU when
    they stand inside a ``scan``, and the training loop is one.
    """

    width: int
    patch: int = 5
    dtype: DTypeLike | None = None  # of the computations

    @nn.compact
    def __call__(self, maps: UInt8[Array, "*b 2 k k"]) -> Float[Array, "*b width"]:
        maps, dense = maps.astype(self.dtype or jnp.float32), functools.partial(Dense, dtype=self.dtype)
        lead, n, p = maps.shape[:-3], maps.shape[-1] // self.patch, self.patch
        x = maps.reshape(*lead, 2, n, p, n, p)
        x = jnp.moveaxis(x, (-5, -3, -1), (-3, -2, -1)).reshape(*lead, n, n, 2 * p * p)
        x = nn.relu(dense(32, name="conv5")(x))
        rows = [x[..., i : n - 2 + i, j : n - 2 + j, :] for i in range(3) for j in range(3)]
        x = nn.relu(dense(64, name="conv3")(jnp.concatenate(rows, -1)))
        return dense(self.width, name="out")(x.reshape(*lead, -1))


def goal_features(goal: Float[Array, "*b 2"]) -> Float[Array, "*b 6"]:
    """The vector to the goal [m] far off, close by, and as a direction: half a metre matters at the end of forty."""
    distance = jnp.linalg.norm(goal, axis=-1, keepdims=True)
    return jnp.concatenate([goal / GOAL_SCALE_M, jnp.tanh(goal / 2.0), goal / (distance + 0.1)], -1)


class Block(nn.Module):
    """Pre-norm attention and MLP with ReLU (paper, table I)."""

    config: ModelConfig
    dtype: DTypeLike | None = None
    attention: Attention | None = None

    def setup(self) -> None:
        width, dense = self.config.width, functools.partial(Dense, dtype=self.dtype)
        self.norm_attention, self.norm_mlp = nn.LayerNorm(dtype=self.dtype), nn.LayerNorm(dtype=self.dtype)
        self.qkv = dense(3 * width)
        self.project = dense(width)
        self.up, self.down = dense(4 * width), dense(width)
        self.dropout = Dropout(self.config.dropout)

    def heads(self, x: Float[Array, "B T W"]) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Queries, keys and values, each [B, T, heads, W / heads]."""
        # Split, not indexed: the gradients are then joined again, and not each of them padded to the whole and added.
        q, k, v = jnp.split(self.qkv(self.norm_attention(x)), 3, -1)
        heads = (*x.shape[:-1], self.config.heads, -1)
        return q.reshape(heads), k.reshape(heads), v.reshape(heads)

    def attend(
        self, x: jax.Array, q: jax.Array, k: jax.Array, v: jax.Array, mask: Bool[Array, "B T M"], deterministic: bool
    ) -> jax.Array:
        mixed = jax.nn.dot_product_attention(q, k, v, mask=mask[:, None], implementation=self.attention)
        x = x + self.dropout(self.project(mixed.reshape(x.shape)), deterministic=deterministic)
        hidden = self.down(nn.relu(self.up(self.norm_mlp(x))))
        return x + self.dropout(hidden, deterministic=deterministic)


def body_features(proprio: Float[Array, "*b P"]) -> tuple[Float[Array, "*b 2"], Float[Array, "*b P-1"]]:
    """The heading, and the body in its own frame with all entries of order one."""
    heading, own = own_frame(proprio)
    poses = 4 + (own.shape[-1] - 10) // 2  # height, up and joints; velocities come after them
    return heading, jnp.concatenate([own[..., :poses], own[..., poses:] / SPEED_SCALE], -1)


def directions(x: Float[Array, "*b W"], heading: Float[Array, "*b 2"], n: int) -> Float[Array, "*b 2n"]:
    """n planar vectors of the world from a dense layer, as a robot of that heading sees them; inside a module."""
    where = Dense(2 * n)(x)
    where = turn(heading[..., None, :], where.reshape(*where.shape[:-1], n, 2))
    return where.reshape(*where.shape[:-2], -1)


class Modes(NamedTuple):
    """Actions to choose from."""

    action: Float[Array, "*b M A"]
    logit: Float[Array, "*b M"]  # how likely each is

    def best(self) -> Float[Array, "*b A"]:
        """The likeliest."""
        return self.take(jnp.argmax(self.logit, -1))

    def take(self, mode: Int[Array, "*b"]) -> Float[Array, "*b A"]:
        """The action of the given mode of each."""
        return jnp.take_along_axis(self.action, mode[..., None, None], -2).squeeze(-2)


class ControlTransformer(nn.Module):
    """pi_theta(a_t | R_{t-K+1..t}, s_{t-K+1..t}, a_{t-K+1..t-1}).

    ``dtype`` is that of the computations, for training on accelerators in bfloat16; parameters and actions stay
    float32, and acting with a cache is for a model without it. ``attention`` names one of jax's implementations.
    ``head`` gives the actions of all modes from what the trunk makes of a state token, and proprioception
    (``heads.make_head``); without one they are linear in what the trunk makes (paper).
    """

    config: ModelConfig
    action_size: int
    head: nn.Module | None = None
    dtype: DTypeLike | None = None
    attention: Attention | None = None

    def setup(self) -> None:
        c, dense = self.config, functools.partial(Dense, dtype=self.dtype)
        self.encode_map = MapEncoder(c.width, dtype=self.dtype)
        self.embed_goal = dense(c.width)
        self.embed_state = dense(c.width)
        if c.actions:
            self.embed_action = dense(c.width)
        self.embed_return = dense(c.width)
        self.embed_timestep = nn.Embed(
            c.max_timestep, c.width, embedding_init=nn.initializers.normal(0.02), dtype=self.dtype
        )
        self.norm_in, self.norm_out = nn.LayerNorm(dtype=self.dtype), nn.LayerNorm(dtype=self.dtype)
        self.dropout = Dropout(c.dropout)
        self.blocks = [Block(c, self.dtype, self.attention) for _ in range(c.layers)]
        if self.head is None:
            self.predict_action = Dense(c.modes * self.action_size)
        if c.modes > 1:
            self.predict_mode = Dense(c.modes)

    def _embed_time(self, timestep: jax.Array) -> jax.Array:
        """The embedding of the absolute timestep, shared by the tokens of a step."""
        return self.embed_timestep(jnp.minimum(timestep, self.config.max_timestep - 1))

    def _embed_return(self, rtg: jax.Array) -> jax.Array:
        known = rtg / RETURN_DIVISOR if self.config.returns else jnp.zeros_like(rtg)
        return self.embed_return(known[..., None])

    def _embed_state(self, maps: jax.Array, proprio: jax.Array, goal: jax.Array) -> jax.Array:
        """Map, proprioception and goal joined into one embedding."""
        goal = self.embed_goal(goal_features(goal))
        if self.config.frame == "heading":
            proprio = jnp.concatenate(body_features(proprio), -1)
        return self.embed_state(jnp.concatenate([self.encode_map(maps), proprio, goal], -1))

    def _predict(self, x: Float[Array, "*b W"], proprio: Float[Array, "*b P"]) -> Modes:
        """Actions from what the trunk makes of state tokens."""
        x, n = self.norm_out(x).astype(jnp.float32), self.config.modes
        if self.head is not None:
            action = self.head(x, proprio)
        else:
            action = self.predict_action(x).reshape(*x.shape[:-1], n, self.action_size)
        return Modes(action, self.predict_mode(x) if n > 1 else jnp.zeros((*x.shape[:-1], n), jnp.float32))

    def __call__(self, *window: Any, **options: Any) -> Float[Array, "B S A"]:
        """The likeliest of the actions that ``propose`` has for each step."""
        return self.propose(*window, **options).best()

    def propose(
        self,
        maps: UInt8[Array, "B S 2 k k"],
        proprio: Float[Array, "B S P"],
        goal: Float[Array, "B S 2"],
        action: Float[Array, "B S A"],
        rtg: Float[Array, "B S"],
        timestep: Int[Array, "B S"],
        valid: Float[Array, "B S"],
        *,
        context: int | None = None,
        deterministic: bool = True,
    ) -> Modes:
        """Predicted actions of all steps of pieces of S steps. Steps that are not ``valid`` must come last."""
        (batch, steps), n = rtg.shape, self.config.tokens
        tokens = [self._embed_return(rtg), self._embed_state(maps, proprio, goal)]
        tokens += [self.embed_action(action)] if self.config.actions else []
        x = (jnp.stack(tokens, 2) + self._embed_time(timestep)[:, :, None]).reshape(batch, n * steps, -1)
        x = self.dropout(self.norm_in(x), deterministic=deterministic)
        step = jnp.arange(n * steps, dtype=jnp.int32) // n
        mask = band(step, step, context or self.config.context) & jnp.tri(n * steps, dtype=bool)
        mask = mask[None] & (jnp.repeat(valid, n, 1) > 0)[:, None, :] | jnp.eye(n * steps, dtype=bool)[None]
        for block in self.blocks[:-1]:
            x = block.attend(x, *block.heads(x), mask, deterministic)
        # Only the outputs of the state tokens are used, so the last block computes only these.
        q, k, v = self.blocks[-1].heads(x)
        states = slice(1, None, n)
        x = self.blocks[-1].attend(x[:, states], q[:, states], k, v, mask[:, states], deterministic)
        return self._predict(x, proprio)

    def act(
        self,
        cache: Cache,
        maps: UInt8[Array, "N 2 k k"],
        proprio: Float[Array, "N P"],
        goal: Float[Array, "N 2"],
        rtg: Float[Array, "N"],
    ) -> tuple[Float[Array, "N A"], Cache]:
        """The next action of N episodes, computing only the tokens that are new: a_{t-1}, R_t and s_t."""
        n, stride = self.config.tokens, self.config.stride
        t, which = cache.now // stride, cache.now % stride  # steps of the memory whose turn it is, and which that is
        mine = functools.partial(jax.lax.dynamic_index_in_dim, index=which, keepdims=False)
        now = self._embed_time(cache.now)[None]
        tokens, steps = [self._embed_return(rtg) + now, self._embed_state(maps, proprio, goal) + now], [t, t]
        if self.config.actions:
            before = self._embed_time(cache.now - stride)[None]
            tokens.insert(0, self.embed_action(mine(cache.action, axis=1)) + before)
            # The first step has no action before it: its token is said to be of a step that no query reaches.
            steps.insert(0, jnp.where(t > 0, t - 1, _NEVER))
        x, step_of = self.norm_in(jnp.stack(tokens, 1)), jnp.stack(steps)
        place = t % (cache.step.shape[-1] // n) * n
        all_steps = jax.lax.dynamic_update_slice(cache.step, step_of[None], (which, place))
        step = mine(all_steps, axis=0)
        order = jnp.arange(n, dtype=jnp.int32)
        later = jnp.zeros_like(step).at[place + order].set(order)  # of the new tokens, none sees a later one
        mask = band(step_of, step, self.config.context_acting) & (later[None, :] <= order[:, None])
        mask = jnp.broadcast_to(mask, (x.shape[0], *mask.shape))
        keys, values = [], []
        for block, old_keys, old_values in zip(self.blocks, cache.keys, cache.values, strict=True):
            q, k, v = block.heads(x)
            for new, old, kept in ((k, old_keys, keys), (v, old_values, values)):
                at = (_FIRST, which, _FIRST, _FIRST, place)
                kept.append(jax.lax.dynamic_update_slice(old, jnp.moveaxis(new, 1, -1)[:, None], at))
            seen_k, seen_v = (jnp.moveaxis(mine(kept[-1], axis=1), -1, 1) for kept in (keys, values))
            x = block.attend(x, q, seen_k, seen_v, mask, True)
        modes = self._predict(x[:, -1], proprio)
        stay = self.config.commitment * jax.nn.one_hot(cache.mode, self.config.modes)
        mode = jnp.argmax(modes.logit + stay, -1).astype(jnp.int32)
        action = jnp.clip(modes.take(mode), -1.0, 1.0)
        actions = jax.lax.dynamic_update_slice(cache.action, action[:, None], (_FIRST, which, _FIRST))
        return action, Cache(tuple(keys), tuple(values), all_steps, cache.now + 1, actions, mode)

    def act_on_window(
        self,
        history: History,
        maps: UInt8[Array, "N 2 k k"],
        proprio: Float[Array, "N P"],
        goal: Float[Array, "N 2"],
        rtg: Float[Array, "N"],
    ) -> tuple[Float[Array, "N A"], History]:
        """The next action of N episodes, from the last K steps and this one."""
        places = history.rtg.shape[1]
        place = jnp.minimum(history.now, places - 1)
        shift = (history.now >= places).astype(jnp.int32)

        def put(kept: jax.Array, new: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_index_in_dim(jnp.roll(kept, -shift, axis=1), new, place, 1)

        blank = jnp.zeros_like(history.action[:, 0])
        seen = history.replace(
            map=put(history.map, maps), proprio=put(history.proprio, proprio), goal=put(history.goal, goal),
            action=put(history.action, blank), rtg=put(history.rtg, rtg), now=history.now + 1,
        )  # fmt: skip
        order = jnp.arange(places, dtype=jnp.int32)
        timestep = jnp.broadcast_to(history.now - place + order, rtg.shape + order.shape)
        valid = jnp.broadcast_to((order <= place).astype(jnp.float32), timestep.shape)
        modes = self.propose(seen.map, seen.proprio, seen.goal, seen.action, seen.rtg, timestep, valid, context=places)
        action = jnp.clip(jax.lax.dynamic_index_in_dim(modes.best(), place, 1, keepdims=False), -1.0, 1.0)
        return action, seen.replace(action=jax.lax.dynamic_update_index_in_dim(seen.action, action, place, 1))


def band(query: Int[Array, "T"], key: Int[Array, "M"], context: int) -> Bool[Array, "T M"]:
    """Whether a token of step ``query`` may see one of step ``key``: not later, and less than ``context`` ago."""
    ago = query[:, None] - key[None, :]
    return (ago >= 0) & (ago < context)


def empty_cache(config: ModelConfig, action_size: int, n: int) -> Cache:
    """The cache before the first step of N episodes."""
    places = config.tokens * (config.context_acting + 1)
    empty = jnp.zeros((n, config.stride, config.heads, config.width // config.heads, places), jnp.float32)
    return Cache(
        keys=(empty,) * config.layers,
        values=(empty,) * config.layers,
        step=jnp.full((config.stride, places), _NEVER, jnp.int32),
        now=jnp.zeros((), jnp.int32),
        action=jnp.zeros((n, config.stride, action_size), jnp.float32),
        mode=jnp.full(n, -1, jnp.int32),
    )


def empty_history(config: ModelConfig, proprio_size: int, action_size: int, n: int) -> History:
    """The history before the first step of N episodes."""
    k = config.context_acting
    proprio, goal, action = (jnp.zeros((n, k, size), jnp.float32) for size in (proprio_size, 2, action_size))
    maps = jnp.zeros((n, k, 2, MAP_CELLS, MAP_CELLS), jnp.uint8)
    return History(maps, proprio, goal, action, jnp.zeros((n, k), jnp.float32), jnp.zeros((), jnp.int32))


def sample_inputs(proprio_size: int, action_size: int) -> tuple[jax.Array, ...]:
    """Inputs of one step, from which parameters are initialised."""
    one = jnp.zeros((1, 1), jnp.float32)
    maps = jnp.zeros((1, 1, 2, MAP_CELLS, MAP_CELLS), jnp.uint8)
    proprio, goal, action = (jnp.zeros((1, 1, size), jnp.float32) for size in (proprio_size, 2, action_size))
    return maps, proprio, goal, action, one, jnp.zeros((1, 1), jnp.int32), one
