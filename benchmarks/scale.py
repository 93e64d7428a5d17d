"""Estimate the resources for 10^6 trajectories on 8 GPUs and on 64 hosts, and write ``docs/scaling.md``.

    python benchmarks/scale.py

This is a calculation, because we have no machine of this size. Speeds are rows of ``benchmarks/results``. Sizes are
those of the arrays. XLA gives memory and messages of an update, for this model on two devices. Values from data sheets
are fields of ``Assumed``. If a row is missing, the error names the benchmark to run.
"""

import json
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import tyro
from _harness import RESULTS
from transformer import trajectories

from ct_envs import UserError, load_maze, stack_mazes
from ct_envs.robots import get_robot
from ct_jax.cli import guarded, leave
from ct_jax.configs import get_preset
from ct_jax.fit import Fit, transformer_loss
from ct_jax.heads import make_head
from ct_jax.learner import updates_on
from ct_jax.model import sizes
from ct_jax.runtime.devices import replicated, sharded
from ct_jax.runtime.files import prepare_outputs, write_text
from ct_jax.runtime.terminal import printable
from ct_jax.settings import Settings, controller_config
from ct_jax.transformer import ControlTransformer, sample_inputs

PAGE = Path(__file__).parents[1] / "docs" / "scaling.md"
SMALL = 1024  # trajectories in the program that XLA compiles for memory and messages
INT32 = 2**31 - 1  # maximum number of steps in the data


@dataclass(frozen=True)
class Assumed:
    """The host: an NVIDIA DGX H100, from its data sheet (2023) and that of the H100 SXM."""

    gpus: int = 8  # per host
    gpu_bytes: float = 80e9  # memory of a GPU
    gpu_flop_s: float = 67e12  # float32 operations per second of a GPU
    share: float = 0.4  # share of ``gpu_flop_s`` that a training step reaches: a guess, until a GPU is measured
    nvlink_bytes_s: float = 450e9  # from a GPU to the others in its host, one way (900e9 both ways)
    port_bytes_s: float = 50e9  # from a GPU to other hosts: each GPU has one port of 400 Gbit/s
    message_s: float = 10e-6  # latency of a message: a guess
    cores: int = 112  # CPU cores of a host
    host_bytes: float = 2e12  # memory of a host


@dataclass(frozen=True)
class ScaleOptions:
    """The case to estimate."""

    trajectories: int = 1_000_000
    """Number of trajectories."""
    hosts: int = 64
    """Number of hosts. A single host is estimated, too."""
    robot: str = "ant"
    """Robot."""
    preset: str = "paper"
    """Preset of model and training. The collection has the settings of the preset cpu, which were measured."""
    results: Path = RESULTS
    """Folder of the measured results."""
    page: Path = PAGE
    """Page to write."""


class Measured(NamedTuple):
    """The measured rows."""

    collected: dict[str, Any]  # trajectories/s
    roadmap: dict[str, Any]  # ms
    updates: dict[str, Any]  # steps/s
    flop: dict[str, Any]  # GFLOP/s of the updates


class Sizes(NamedTuple):
    """Sizes of the method's arrays [bytes]."""

    trajectory: int  # on a device, with its return-to-go
    step: int  # one step of a trajectory
    parameters: int
    state: int  # parameters and optimizer
    temporary: int  # temporary memory of an update, summed over the devices
    messages: int  # number of collective operations per update


class Plan(NamedTuple):
    """Estimated times [s] and memory [bytes] for a number of hosts."""

    hosts: int
    used: int  # number of GPUs that share the batch
    gpu: float  # memory of a GPU
    host: float  # memory of a host
    rollouts: float  # time
    roadmaps: float  # time
    compute: float  # computation time of an update
    traffic: float  # communication time of an update


def look(file: Path, name: str, unit: str) -> dict[str, Any] | None:
    """A row of a file; None if the row or the file is missing."""
    rows = json.loads(file.read_text("utf-8")) if file.is_file() else []
    return next((row for row in rows if (row["name"], row["unit"]) == (name, unit)), None)


def find(folder: Path, benchmark: str, name: str, unit: str) -> dict[str, Any]:
    """A row of the results. Raises UserError with the benchmark to run if it is missing."""
    file = folder / f"{benchmark}.json"
    found = look(file, name, unit)
    if found is None:
        script = f"benchmarks/{benchmark.removesuffix('-gpu')}.py"
        raise UserError(f"{file.name} has no row '{name}' in {unit}; run: python {script}")
    return found


def measured(options: ScaleOptions, samples: int) -> Measured:
    """The measured rows. Raises UserError if one is missing."""
    row, robot = options.results, options.robot
    trained, update = "transformer-gpu", f"{robot}, bfloat16"
    if look(row / f"{trained}.json", update, "steps/s") is None:
        trained, update = "transformer", f"{robot}, float32"
    return Measured(
        find(
            row, "rollout", f"{robot}, collection guided by {get_preset('cpu', robot).collect.guide}", "trajectories/s"
        ),
        find(row, "prm", f"{samples} samples: build and table", "ms"),
        find(row, trained, update, "steps/s"),
        find(row, trained, update, "GFLOP/s"),
    )


def weigh(robot: str, settings: Settings) -> Sizes:
    """Sizes of the arrays; and memory and messages of an update, compiled by XLA for all devices."""
    size = sizes(robot)[1]
    model = ControlTransformer(settings.model, size, make_head(settings.model, size, controller_config(settings)))
    learner = Fit(transformer_loss(model), settings.fit, settings.model.map_cell_m, get_robot(robot))
    steps = -(-settings.collect.horizon // 256) * 256  # padded as in ``spread``
    data = jax.eval_shape(lambda: trajectories(robot, SMALL, steps))
    rtg = jax.ShapeDtypeStruct((SMALL, steps), jnp.float32)
    params = jax.eval_shape(model.init, jax.random.key(0), *sample_inputs(*sizes(robot)))
    state = jax.eval_shape(learner.create, jax.random.key(0), params)
    put = lambda tree, where: jax.tree.map(  # noqa: E731
        lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where), tree
    )
    everywhere, split = replicated(learner.mesh), sharded(learner.mesh)
    placed = put(data, split).replace(length=put(data.length, everywhere))
    mazes = put(stack_mazes([load_maze("antmaze-large")]), everywhere)
    program = (
        updates_on(learner.mesh).lower(put(state, everywhere), placed, put(rtg, split), mazes, updates=1).compile()
    )
    memory: Any = program.memory_analysis()
    weight = lambda tree: sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))  # noqa: E731
    return Sizes(
        trajectory=weight((data, rtg)) // SMALL,
        step=weight((data, rtg)) // (SMALL * steps),
        parameters=weight(params),
        state=weight((state.params, state.optimizer)),
        temporary=memory.temp_size_in_bytes * learner.mesh.size,
        messages=len(
            re.findall(r"= .* (?:all-\w+|reduce-scatter|collective-permute)(?:-start)?\(", str(program.as_text()))
        ),
    )


def plan(hosts: int, options: ScaleOptions, settings: Settings, found: Measured, size: Sizes, assumed: Assumed) -> Plan:
    """The estimate for a number of hosts."""
    n, batch = options.trajectories, settings.fit.batch
    shares = [k for k in range(1, assumed.gpus + 1) if batch % (k * hosts) == 0]
    each = max(shares, default=0)  # as ``data_mesh`` chooses
    used = max(1, each * hosts)
    collect = settings.collect
    maps = math.ceil(max(1, collect.envs // collect.reset_interval) / hosts)  # roadmaps per wave in the busiest process
    core_rate = found.collected["value"] / cores_of(found.collected)
    sent = size.parameters + batch * settings.fit.steps * size.step  # the gradient, and the steps of the batch
    inside = 2 * sent / assumed.nvlink_bytes_s * (1 - 1 / max(1, each))
    between = 2 * sent / max(1, each) / assumed.port_bytes_s * (1 - 1 / hosts)
    return Plan(
        hosts=hosts,
        used=each * hosts,
        gpu=n * size.trajectory / used + size.state + size.temporary / used,
        host=3 * n * size.trajectory / hosts,  # three copies: the collected waves, joined, and padded
        rollouts=n / (core_rate * assumed.cores * hosts),
        roadmaps=n / collect.envs * maps * found.roadmap["value"] / 1e3,
        compute=update_s(found, assumed) / used,
        traffic=inside + between + size.messages * math.ceil(math.log2(max(2, used))) * assumed.message_s,
    )


def update_s(found: Measured, assumed: Assumed) -> float:
    """Time of an update on one GPU [s]: measured, or estimated from its operations."""
    if on_gpu(found):
        return 1.0 / found.updates["value"]
    return found.flop["value"] / found.updates["value"] * 1e9 / (assumed.share * assumed.gpu_flop_s)


def on_gpu(found: Measured) -> bool:
    """Whether training was measured on an accelerator."""
    return " x " in found.updates["made"]["hardware"]


def cores_of(row: dict[str, Any]) -> int:
    """CPU cores of the machine of a row."""
    said = re.search(r"(\d+) cores?$", row["made"]["hardware"])
    return int(said.group(1)) if said else 1


class Limit(NamedTuple):
    """A limited resource."""

    what: str
    load: float  # demand divided by capacity
    hint: str


def limits(each: Plan, options: ScaleOptions, settings: Settings, assumed: Assumed) -> list[Limit]:
    """All limits, highest load first. A load above 1 is not feasible, or costs more time than the work."""
    gpus = each.hosts * assumed.gpus
    batch = f"make `fit.batch` a multiple of the number of GPUs; {each.used} are used now"
    larger = "a larger batch with a higher learning rate, or fewer hosts per run and several seeds in parallel"
    waves = "more parallel environments (`collect.envs`): each wave has one roadmap per `reset_interval` environments"
    rows = "less padding of trajectories, or 16-bit numbers where nothing is summed"
    copies = "join and pad in place, or write waves to disk"
    numbered = "sample the trajectory first, then the step in it"
    steps = options.trajectories * settings.collect.horizon
    found = [
        Limit(f"{gpus} GPUs / windows in a batch (each GPU needs at least one)", gpus / settings.fit.batch, batch),
        Limit("update: communication time / computation time", each.traffic / each.compute, larger),
        Limit("collection: time for roadmaps / time for rollouts", each.roadmaps / each.rollouts, waves),
        Limit("memory of a GPU", each.gpu / assumed.gpu_bytes, rows),
        Limit("memory of a host", each.host / assumed.host_bytes, copies),
        Limit("number of steps in the data / largest 32-bit index", steps / INT32, numbered),
    ]
    return sorted(found, key=lambda limit: -limit.load)


# ------------------------------------------------------------------------------------------------------- the page


def gigabytes(count: float) -> str:
    """Bytes as text."""
    return f"{count / 1e9:,.3g} GB"


def duration(seconds: float) -> str:
    """Seconds as text."""
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0), ("s", 1.0), ("ms", 1e-3)):
        if seconds >= length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds * 1e6:.3g} µs"


def write(options: ScaleOptions, settings: Settings, found: Measured, size: Sizes, assumed: Assumed) -> str:
    """The text of the page."""
    plans = [plan(hosts, options, settings, found, size, assumed) for hosts in dict.fromkeys((1, options.hosts))]
    return "\n".join(
        [*head(options, found, size, assumed), *table(plans, settings), *breaks(plans, options, settings, assumed), ""]
    )


def head(options: ScaleOptions, found: Measured, size: Sizes, assumed: Assumed) -> Iterator[str]:
    """The case, and the sources of the numbers."""
    gpus, hosts = assumed.gpus, options.hosts
    yield f"# {options.trajectories:,} trajectories on {gpus} GPUs, and on {hosts} hosts with {gpus} GPUs each\n"
    yield "Written by `python benchmarks/scale.py`. These are estimates, not measurements.\n"
    yield f"Robot `{options.robot}`, preset `{options.preset}`. Measured:\n"
    yield "| row | value | on |\n|---|---|---|"
    for row in found:
        made = row["made"]
        yield f"| {row['name']} | {row['value']:,.4g} {row['unit']} | {made['hardware']}, commit {made['commit']} |"
    source = "measured" if on_gpu(found) else "estimated from its number of operations and the assumed GPU"
    yield f"\nAn update takes {duration(update_s(found, assumed))} on one GPU ({source}). Sizes:\n"
    yield "| what | size |\n|---|---|"
    yield f"| a trajectory on a device ({size.step} bytes per step) | {size.trajectory / 1e3:,.4g} kB |"
    yield f"| parameters; the gradient has the same size | {size.parameters / 1e6:,.4g} MB |"
    yield f"| a checkpoint (parameters and optimizer) | {size.state / 1e6:,.4g} MB |"
    yield f"| temporary memory of an update, over all devices | {gigabytes(size.temporary)} |"
    yield f"| collective operations per update | {size.messages} |"
    yield (
        "\nAssumptions (`Assumed` in the script gives the sources): "
        + ", ".join(f"`{field.name}` {getattr(assumed, field.name):,g}" for field in fields(assumed))
        + ". Speed is assumed to be proportional to the number of cores and GPUs, which is optimistic. Communication "
        "is assumed not to overlap with computation, which is pessimistic.\n"
    )


def table(plans: list[Plan], settings: Settings) -> Iterator[str]:
    """The table of memory and time."""
    updates = settings.fit.updates
    rows = {
        "GPUs that share a batch": [f"{each.used}" for each in plans],
        "memory of a GPU": [gigabytes(each.gpu) for each in plans],
        "maximum memory of a host": [gigabytes(each.host) for each in plans],
        "collection: rollouts": [duration(each.rollouts) for each in plans],
        "collection: roadmaps, divided among the processes": [duration(each.roadmaps) for each in plans],
        "update: computation": [duration(each.compute) for each in plans],
        "update: communication": [duration(each.traffic) for each in plans],
        f"training, {updates:,} updates": [duration(updates * (each.compute + each.traffic)) for each in plans],
    }
    yield "## Memory and time\n"
    yield "| what | " + " | ".join(f"{each.hosts} host{'s' * (each.hosts > 1)}" for each in plans) + " |"
    yield "|---|" + "---|" * len(plans)
    for name, values in rows.items():
        yield f"| {name} | {' | '.join(values)} |"


def breaks(plans: list[Plan], options: ScaleOptions, settings: Settings, assumed: Assumed) -> Iterator[str]:
    """The table of limits, with remedies."""
    yield "\n## Limits and remedies\n"
    yield (
        "The load is the demand divided by the capacity. A load above 1 is not feasible, or costs more time than the "
        "work itself."
    )
    for each in plans:
        yield f"\n{each.hosts} host{'s' * (each.hosts > 1)}:\n\n| what | load | remedy |\n|---|---|---|"
        for limit in limits(each, options, settings, assumed):
            yield f"| {limit.what} | {limit.load:.3g} | {limit.hint if limit.load > 0.5 else ''} |"


def main(options: ScaleOptions) -> None:
    """Write the page. Raises UserError if a measurement is missing."""
    prepare_outputs(options.page)
    settings = get_preset(options.preset, options.robot)
    settings = replace(settings, collect=get_preset("cpu", options.robot).collect)
    found = measured(options, settings.prm.samples)
    text = write(options, settings, found, weigh(options.robot, settings), Assumed())
    write_text(options.page, text)
    print(printable(options.page))


if __name__ == "__main__":
    # With one device, an update would have no messages to count.
    os.environ.setdefault("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    chosen = tyro.cli(ScaleOptions, description=__doc__)
    leave(guarded(lambda: main(chosen)))
