"""Rules for the sources: imports go one way, functions are short, and nothing is unpickled."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import ct_jax

ROOT = Path(__file__).parents[1]
# The stages of ct_jax. Each may import earlier stages and its own parts. Add new modules here. A part that is listed
# counts as a stage.
ORDER = [
    *["runtime", "types", "worlds", "rollout", "learner", "prm", "guides", "pairs", "trajectories", "guided"],
    *["collect", "controllers", "controller", "dense", "transformer", "heads", "value", "fit", "policy", "agent"],
    *["evaluate", "finetune", "transfer", "settings", "configs", "model", "baselines", "runtime.run", "report"],
    *["worlds.mazes", "worlds.rooms", "worlds.maze_runs", "worlds.room_runs", "pipeline", "cli"],
]
# What steps robots, and the worlds that hold it.
SIMULATORS = {
    *["ct_envs.MazeEnv", "ct_envs.maze_env", "ct_envs.turtlebot3.Turtlebot3Env", "ct_envs.turtlebot3.Turtlebot3Config"],
    *["ct_envs.turtlebot3_pool.Turtlebot3Pool", "ct_envs.turtlebot3_pool.Episode"],
    *["ct_jax.worlds.mazes", "ct_jax.worlds.maze_runs", "ct_jax.worlds.rooms", "ct_jax.worlds.room_runs"],
}
USERS = {"experiments", "benchmarks", "tests"}  # of the packages: no package knows of them
LEARNING = {"optax", "orbax", "flax.linen", "flax.nnx", "flax.training", "brax.training", "tensorboardX"}
PICKLERS = {"pickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "brax.io.model"}
LONGEST = 80  # lines of a function


def sources(folder: str) -> dict[str, Path]:
    """The files of a folder by their import names. ``__init__`` has the name of its package."""
    top = ROOT / ("envs" if folder == "ct_envs" else "")
    files = sorted((top / folder).rglob("*.py"))
    return {".".join(file.relative_to(top).with_suffix("").parts).removesuffix(".__init__"): file for file in files}


PACKAGES = sources("ct_envs") | sources("ct_jax")
SHIPPED = PACKAGES | sources("experiments") | sources("benchmarks")


def imports(text: str, module: str, *, package: bool = False) -> Iterator[str]:
    """All imports in a source, with the imported names, such as "ct_jax.prm.Roadmap"."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = module.split(".")
            above = parts[: len(parts) - node.level + package] if node.level else []
            yield from (".".join([*above, *filter(None, [node.module]), alias.name]) for alias in node.names)


def imports_of(module: str) -> set[str]:
    file = SHIPPED[module]
    return set(imports(file.read_text("utf-8"), module, package=file.name == "__init__.py"))


def within(name: str, modules: set[str]) -> bool:
    """Whether a dotted name is one of the modules, or is inside one of them."""
    return any(name == module or name.startswith(module + ".") for module in modules)


def stage_of(module: str) -> str:
    """The stage that a module of ct_jax, or a name in one, belongs to; "" for the package itself."""
    parts = module.split(".")[1:]
    part = ".".join(parts[:2])
    return part if part in ORDER else [*parts, ""][0]


def rank(module: str) -> int:
    """The position of a module of ct_jax in the order; -1 for the package itself."""
    stage = stage_of(module)
    return ORDER.index(stage) if stage else -1


def later_stages(text: str, module: str, *, package: bool = False) -> list[str]:
    """The forbidden imports of a module of ct_jax: later stages, and public names, which hide the stages."""
    names = [name for name in imports(text, module, package=package) if within(name, {"ct_jax"})]
    stages = [name for name in names if name.split(".")[1:2] and name.split(".")[1] in ORDER]
    public = [name for name in names if name.split(".")[1:2] and name.split(".")[1] in ct_jax.__all__]
    return [name for name in stages if rank(name) > rank(module)] + public


def at_import(text: str) -> str:
    """A source without the code for type checkers."""

    class Runs(ast.NodeTransformer):
        def visit_If(self, node: ast.If) -> ast.AST | list[ast.stmt]:
            typing = isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
            return node.orelse if typing else self.generic_visit(node)

    return ast.unparse(Runs().visit(ast.parse(text)))


def simulators(text: str, module: str, *, package: bool = False) -> list[str]:
    """Imports of what steps robots, or of modules that lead to it."""
    names = imports(text, module, package=package)
    return [name for name in names if within(name, SIMULATORS) or any(within(each, {name}) for each in SIMULATORS)]


def long_functions(text: str) -> list[str]:
    functions = (n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))
    return [node.name for node in functions if (node.end_lineno or 0) - node.lineno + 1 > LONGEST]


def unpicklings(text: str, module: str = "") -> list[str]:
    """Imports of pickle modules, and calls that allow NumPy to unpickle."""
    calls = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call))
    keywords = (keyword for call in calls for keyword in call.keywords if keyword.arg == "allow_pickle")
    allowed = [k.arg for k in keywords if not (isinstance(k.value, ast.Constant) and k.value.value is False)]
    return [name for name in imports(text, module) if within(name, PICKLERS)] + [str(name) for name in allowed]


# -------------------------------------------------------------------------------------------------- the rules


def test_sources_are_found():
    assert {"ct_envs", "ct_envs.maze", "ct_jax", "ct_jax.prm", "ct_jax.worlds.mazes"} <= set(PACKAGES)


@pytest.mark.parametrize("module", PACKAGES)
def test_packages_do_not_import_their_users(module):
    below = {"ct_jax"} if module.startswith("ct_envs") else set()
    assert not [name for name in imports_of(module) if within(name, USERS | below)]


@pytest.mark.parametrize("module", sources("ct_envs"))
def test_ct_envs_does_not_import_learning(module):
    assert not [name for name in imports_of(module) if within(name, LEARNING)]


@pytest.mark.parametrize("module", sources("ct_jax"))
def test_stages_import_only_earlier_stages(module):
    stage = [*module.split("."), ""][1]
    assert not stage or stage in ORDER, f"give {stage} its place in ORDER"
    file = SHIPPED[module]
    text = file.read_text("utf-8")
    text = text if stage else at_import(text)  # the package itself names stages for type checkers, and imports none
    assert not later_stages(text, module, package=file.name == "__init__.py")


@pytest.mark.parametrize("module", sources("ct_jax"))
def test_only_worlds_know_a_simulator(module):
    """A new simulator is a new file of that folder, and no other change."""
    file = SHIPPED[module]
    found = simulators(at_import(file.read_text("utf-8")), module, package=file.name == "__init__.py")
    assert not found or within(module, {"ct_jax.worlds"})


@pytest.mark.parametrize("module", SHIPPED)
def test_functions_are_short(module):
    assert not long_functions(SHIPPED[module].read_text("utf-8"))


@pytest.mark.parametrize("module", SHIPPED)
def test_nothing_is_unpickled(module):
    assert not unpicklings(SHIPPED[module].read_text("utf-8"), module)


# -------------------------------------------------------------------------------- and that they can be broken


@pytest.mark.parametrize(
    ("text", "module", "found"),
    [
        ("from ct_jax.collect import collect", "ct_jax.prm", ["ct_jax.collect.collect"]),
        ("import ct_jax.cli", "ct_jax.report.page", ["ct_jax.cli"]),
        ("from ct_jax import pipeline, __version__", "ct_jax.fit", ["ct_jax.pipeline"]),
        ("def f():\n    from ..fit import fit", "ct_jax.controllers.sac", ["ct_jax.fit.fit"]),
        ("from . import evaluate", "ct_jax.policy", ["ct_jax.evaluate"]),
        ("from ct_jax.prm import Roadmap", "ct_jax", ["ct_jax.prm.Roadmap"]),
        ("from ct_jax import ControlTransformer", "ct_jax.prm", ["ct_jax.ControlTransformer"]),
        ("from ct_jax.prm import Roadmap\nimport ct_envs", "ct_jax.collect", []),
        ("from ct_jax.report.page import page", "ct_jax.report.words", []),
        ("from .sac import Sac", "ct_jax.controllers.differential_drive", []),
    ],
)
def test_wrong_import_is_found(text, module, found):
    assert later_stages(text, module) == found


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("from ct_envs import MazeEnv, UserError", ["ct_envs.MazeEnv"]),
        ("from ct_envs.maze_env import broke_off", ["ct_envs.maze_env.broke_off"]),
        ("def f():\n    from ct_envs.turtlebot3 import Turtlebot3Env as E", ["ct_envs.turtlebot3.Turtlebot3Env"]),
        ("from ct_envs import turtlebot3_pool", ["ct_envs.turtlebot3_pool"]),
        ("import ct_envs", ["ct_envs"]),
        ("from ct_jax.worlds.mazes import run", ["ct_jax.worlds.mazes.run"]),
        ("from ct_envs.turtlebot3_pool import PoolFrame\nfrom ct_envs.turtlebot3 import RADIUS_M\nimport mujoco", []),
        ("from ct_envs.maze import Maze\nfrom ct_jax.worlds import kind_of", []),
    ],
)  # fmt: skip
def test_a_simulator_is_found(text, found):
    assert simulators(text, "ct_jax.collect") == found


def test_what_only_type_checkers_read_is_no_import():
    text = "if TYPE_CHECKING:\n    import ct_jax.prm\nelse:\n    import ct_jax.fit\nif x:\n    import ct_jax.pipeline"
    assert later_stages(at_import(text), "ct_jax") == ["ct_jax.fit", "ct_jax.pipeline"]


def test_relative_imports_start_at_package():
    assert list(imports("from .page import page", "ct_jax.report", package=True)) == ["ct_jax.report.page.page"]
    assert list(imports("from .page import page", "ct_jax.report.words")) == ["ct_jax.report.page.page"]


def test_long_function_is_found():
    body = "    x = 1\n"
    assert long_functions("def short():\n" + (LONGEST - 1) * body) == []
    assert long_functions("class A:\n  def long():\n" + LONGEST * body) == ["long"]


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from pickle import loads",
        "def f():\n    import dill as d",
        "from brax.io import model",
        "np.load(file, allow_pickle=True)",
        "np.load(file, allow_pickle=flag)",
    ],
)
def test_unpickling_is_found(text):
    assert unpicklings(text)
    assert not unpicklings("import numpy as np\nnp.load(file, allow_pickle=False)")
