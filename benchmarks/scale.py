"""What 10^6 trajectories, 8 GPUs and 64 hosts would take: ``docs/scaling.md``, from what smaller machines measured.

    python benchmarks/scale.py

No machine here can run it, so this is a dry run on paper: speeds are rows of ``benchmarks/results``, sizes are those of
the arrays themselves, memory and messages of an update are XLA's for this model on two devices, and everything that
stands in a data sheet only is a field of ``Assumed``. Where a row is missing, it says which benchmark to run.
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
from ct_jax.devices import replicated, sharded
from ct_jax.files import prepare_outputs, write_text
from ct_jax.fit import Fit, transformer_loss
from ct_jax.heads import make_head
from ct_jax.learner import updates_on
from ct_jax.model import sizes
from ct_jax.settings import Settings, controller_config
from ct_jax.terminal import printable
from ct_jax.transformer import ControlTransformer, sample_inputs

PAGE = Path(__file__).parents[1] / "docs" / "scaling.md"
SMALL = 1024  # trajectories of the program whose memory and messages are XLA's
INT32 = 2**31 - 1  # steps that windows can be drawn from


@dataclass(frozen=True)
class Assumed:
    """A host that none of us has: an NVIDIA DGX H100, by its data sheet (2023) and that of the H100 SXM."""

    gpus: int = 8  # of a host
    gpu_bytes: float = 80e9  # memory of a GPU
    gpu_flop_s: float = 67e12  # float32 operations a second of a GPU
    share: float = 0.4  # of them that a training step reaches: a guess, used only until a GPU is measured
    nvlink_bytes_s: float = 450e9  # of a GPU to the others of its host, one way (900e9 both)
    port_bytes_s: float = 50e9  # of a GPU to other hosts: one port of 400 Gbit/s each
    message_s: float = 10e-6  # of a message, however small: a guess
    cores: int = 112  # CPU cores of a host
    host_bytes: float = 2e12  # memory of a host


@dataclass(frozen=True)
class ScaleOptions:
    """What is asked."""

    trajectories: int = 1_000_000
    """Trajectories."""
    hosts: int = 64
    """Hosts, besides one."""
    robot: str = "ant"
    """Robot."""
    preset: str = "paper"
    """Settings of model and training; collection is that of the preset cpu, as it was measured."""
    results: Path = RESULTS
    """Folder of what was measured."""
    page: Path = PAGE
    """The page to write."""


class Measured(NamedTuple):
    """Rows of the results."""

    collected: dict[str, Any]  # trajectories/s
    roadmap: dict[str, Any]  # ms
    updates: dict[str, Any]  # steps/s
    flop: dict[str, Any]  # GFLOP/s of them


class Sizes(NamedTuple):
    """What the arrays of the method weigh [bytes]."""

    trajectory: int  # as it lies on a device, with its return-to-go
    step: int  # of it, a step
    parameters: int
    state: int  # parameters and optimizer
    temporary: int  # of an update, on a device with the whole batch
    messages: int  # collective operations of an update


class Plan(NamedTuple):
    """A number of hosts, and what each part of the work would take there [s], [bytes]."""

    hosts: int
    used: int  # GPUs that share the batch
    gpu: float
    host: float
    rollouts: float
    roadmaps: float
    compute: float  # of an update
    traffic: float  # of an update


def look(file: Path, name: str, unit: str) -> dict[str, Any] | None:
    """A row of a file, if both are there."""
    rows = json.loads(file.read_text("utf-8")) if file.is_file() else []
    return next((row for row in rows if (row["name"], row["unit"]) == (name, unit)), None)


def find(folder: Path, benchmark: str, name: str, unit: str) -> dict[str, Any]:
    """A row. Raises UserError naming the benchmark to run where there is none."""
    file = folder / f"{benchmark}.json"
    found = look(file, name, unit)
    if found is None:
        script = f"benchmarks/{benchmark.removesuffix('-gpu')}.py"
        raise UserError(f"{file.name} has no row '{name}' in {unit}; run: python {script}")
    return found


def measured(options: ScaleOptions, samples: int) -> Measured:
    """All rows that are needed. Raises UserError."""
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
    """Sizes of the arrays, and what XLA says of an update on all devices there are."""
    size = sizes(robot)[1]
    model = ControlTransformer(settings.model, size, make_head(settings.model, size, controller_config(settings)))
    learner = Fit(transformer_loss(model), settings.fit, settings.model.map_cell_m, get_robot(robot))
    steps = -(-settings.collect.horizon // 256) * 256  # as ``spread`` fills them up
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
    """What so many hosts would take."""
    n, batch = options.trajectories, settings.fit.batch
    shares = [k for k in range(1, assumed.gpus + 1) if batch % (k * hosts) == 0]
    each = max(shares, default=0)  # as ``data_mesh`` chooses
    used = max(1, each * hosts)
    collect = settings.collect
    maps = math.ceil(max(1, collect.envs // collect.reset_interval) / hosts)  # of a wave, in the process with most
    core_rate = found.collected["value"] / cores_of(found.collected)
    sent = size.parameters + batch * settings.fit.steps * size.step  # gradient and the steps drawn, summed over devices
    inside = 2 * sent / assumed.nvlink_bytes_s * (1 - 1 / max(1, each))
    between = 2 * sent / max(1, each) / assumed.port_bytes_s * (1 - 1 / hosts)
    return Plan(
        hosts=hosts,
        used=each * hosts,
        gpu=n * size.trajectory / used + size.state + size.temporary / used,
        host=3 * n * size.trajectory / hosts,  # what was collected, that joined, and that filled up
        rollouts=n / (core_rate * assumed.cores * hosts),
        roadmaps=n / collect.envs * maps * found.roadmap["value"] / 1e3,
        compute=update_s(found, assumed) / used,
        traffic=inside + between + size.messages * math.ceil(math.log2(max(2, used))) * assumed.message_s,
    )


def update_s(found: Measured, assumed: Assumed) -> float:
    """Seconds of an update on one GPU: measured, or from its operations."""
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
    """Something that there is only so much of."""

    what: str
    load: float  # what is asked of it, in what there is
    hint: str


def limits(each: Plan, options: ScaleOptions, settings: Settings, assumed: Assumed) -> list[Limit]:
    """What is nearest to breaking, first. A load above 1 is broken, or costs more than the work itself."""
    gpus = each.hosts * assumed.gpus
    batch = f"`fit.batch` a multiple of the GPUs; {each.used} are used now"
    larger = "a larger batch with a larger learning rate, or fewer hosts: more seeds side by side need no traffic"
    waves = "more environments at a time (`collect.envs`): a wave has one roadmap for every `reset_interval` of them"
    rows = "shorter rows, or 16 bits for what is not summed"
    copies = "join and fill up in place, or write waves to disk"
    numbered = "draw the trajectory first, then its step"
    steps = options.trajectories * settings.collect.horizon
    found = [
        Limit(f"windows of a batch for {gpus} GPUs (at least one each)", gpus / settings.fit.batch, batch),
        Limit("traffic of an update against its computation", each.traffic / each.compute, larger),
        Limit("roadmaps of a process against its share of rollouts", each.roadmaps / each.rollouts, waves),
        Limit("memory of a GPU", each.gpu / assumed.gpu_bytes, rows),
        Limit("memory of a host", each.host / assumed.host_bytes, copies),
        Limit("steps of the data, which 32 bits must number", steps / INT32, numbered),
    ]
    return sorted(found, key=lambda limit: -limit.load)


# ------------------------------------------------------------------------------------------------------- the page


def gigabytes(count: float) -> str:
    """Bytes in words."""
    return f"{count / 1e9:,.3g} GB"


def duration(seconds: float) -> str:
    """Seconds in words."""
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0), ("s", 1.0), ("ms", 1e-3)):
        if seconds >= length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds * 1e6:.3g} µs"


def write(options: ScaleOptions, settings: Settings, found: Measured, size: Sizes, assumed: Assumed) -> str:
    """The page."""
    plans = [plan(hosts, options, settings, found, size, assumed) for hosts in dict.fromkeys((1, options.hosts))]
    return "\n".join(
        [*head(options, found, size, assumed), *table(plans, settings), *breaks(plans, options, settings, assumed), ""]
    )


def head(options: ScaleOptions, found: Measured, size: Sizes, assumed: Assumed) -> Iterator[str]:
    """What the page is of, and where its figures come from."""
    gpus, hosts = assumed.gpus, options.hosts
    yield f"# {options.trajectories:,} trajectories on {gpus} GPUs, and on {hosts} hosts with as many each\n"
    yield "Written by `python benchmarks/scale.py`; computed, not run.\n"
    yield f"Robot `{options.robot}`, preset `{options.preset}`. Measured:\n"
    yield "| row | value | on |\n|---|---|---|"
    for row in found:
        made = row["made"]
        yield f"| {row['name']} | {row['value']:,.4g} {row['unit']} | {made['hardware']}, commit {made['commit']} |"
    source = "measured" if on_gpu(found) else "from its operations, which were counted, and the assumed GPU"
    yield f"\nAn update on one GPU: {duration(update_s(found, assumed))}, {source}. Counted:\n"
    yield "| what | size |\n|---|---|"
    yield f"| a trajectory on a device ({size.step} bytes a step) | {size.trajectory / 1e3:,.4g} kB |"
    yield f"| parameters, and so the gradient | {size.parameters / 1e6:,.4g} MB |"
    yield f"| parameters and optimizer: a checkpoint | {size.state / 1e6:,.4g} MB |"
    yield f"| temporary memory of an update, all devices together | {gigabytes(size.temporary)} |"
    yield f"| collective operations of an update | {size.messages} |"
    yield (
        "\nAssumed (`Assumed` in the script says from where): "
        + ", ".join(f"`{field.name}` {getattr(assumed, field.name):,g}" for field in fields(assumed))
        + ". Speed is assumed to grow in proportion to cores and GPUs, which is optimistic. Traffic is assumed "
        "never to overlap with computation, which is pessimistic.\n"
    )


def table(plans: list[Plan], settings: Settings) -> Iterator[str]:
    """Memory, time and traffic."""
    updates = settings.fit.updates
    rows = {
        "GPUs that share a batch": [f"{each.used}" for each in plans],
        "memory of a GPU": [gigabytes(each.gpu) for each in plans],
        "memory of a host, at most": [gigabytes(each.host) for each in plans],
        "collection: rollouts": [duration(each.rollouts) for each in plans],
        "collection: roadmaps, shared by the processes": [duration(each.roadmaps) for each in plans],
        "an update: computation": [duration(each.compute) for each in plans],
        "an update: traffic": [duration(each.traffic) for each in plans],
        f"training, {updates:,} updates": [duration(updates * (each.compute + each.traffic)) for each in plans],
    }
    yield "## Memory, time and traffic\n"
    yield "| what | " + " | ".join(f"{each.hosts} host{'s' * (each.hosts > 1)}" for each in plans) + " |"
    yield "|---|" + "---|" * len(plans)
    for name, values in rows.items():
        yield f"| {name} | {' | '.join(values)} |"


def breaks(plans: list[Plan], options: ScaleOptions, settings: Settings, assumed: Assumed) -> Iterator[str]:
    """What breaks first, and what to do about it."""
    yield "\n## What breaks first, and what to do\n"
    yield (
        "A load is the demand divided by the capacity. Above 1 the part is too small, or costs more time than the work."
    )
    for each in plans:
        yield f"\n{each.hosts} host{'s' * (each.hosts > 1)}:\n\n| what | load | what to do |\n|---|---|---|"
        for limit in limits(each, options, settings, assumed):
            yield f"| {limit.what} | {limit.load:.3g} | {limit.hint if limit.load > 0.5 else ''} |"


def main(options: ScaleOptions) -> None:
    """Write the page. Raises UserError where something was not measured."""
    prepare_outputs(options.page)
    settings = get_preset(options.preset, options.robot)
    settings = replace(settings, collect=get_preset("cpu", options.robot).collect)
    found = measured(options, settings.prm.samples)
    text = write(options, settings, found, weigh(options.robot, settings), Assumed())
    write_text(options.page, text)
    print(printable(options.page))


if __name__ == "__main__":
    os.environ.setdefault("XLA_FLAGS", "--xla_force_host_platform_device_count=2")  # for XLA to have messages to count
    chosen = tyro.cli(ScaleOptions, description=__doc__)
    leave(guarded(lambda: main(chosen)))
