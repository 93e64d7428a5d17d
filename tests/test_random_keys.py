"""A random key is used once: it is split, or drawn from, or passed on. A key can be folded several times, but then it
is not used otherwise.

With jax's partitionable generator, ``fold_in(key, i)`` equals ``split(key, n)[i]``. A key that is folded and also split
would give the same randomness twice.
"""

import ast
from collections import defaultdict
from pathlib import Path

import jax
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(
    file for folder in ("ct_jax", "envs", "experiments", "benchmarks") for file in (ROOT / folder).rglob("*.py")
)
_LOOKS = {"key_data", "len", "isinstance", "shape", "wrap_key_data", "sorted"}  # calls that use no randomness


def test_fold_in_equals_split():
    """The reason for the rule."""
    key = jax.random.key(0)
    for i in range(3):
        split, folded = jax.random.split(key, 3)[i], jax.random.fold_in(key, i)
        np.testing.assert_array_equal(jax.random.key_data(split), jax.random.key_data(folded))


def reuses(source: str) -> list[str]:
    """The keys that functions of a source use twice, with their lines."""
    found = []
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, ast.FunctionDef):
            found += _Uses().of(function)
    return found


class _Uses(ast.NodeVisitor):
    """The uses of each key in a function and its nested functions, in the order of the program."""

    def __init__(self) -> None:
        self.uses: dict[str, list[str]] = defaultdict(list)
        self.found: list[str] = []

    def of(self, function: ast.FunctionDef) -> list[str]:
        for statement in function.body:
            self.visit(statement)
        return self.found

    def visit_If(self, node: ast.If) -> None:
        """Only one of two branches is taken. After a branch that returns, its uses do not count."""
        self.visit(node.test)
        before, after = self.uses, []
        for branch in (node.body, node.orelse):
            self.uses = defaultdict(list, {name: list(uses) for name, uses in before.items()})
            for statement in branch:
                self.visit(statement)
            if not (branch and isinstance(branch[-1], ast.Return | ast.Raise | ast.Continue)):
                after.append(self.uses)
        self.uses = max(after, key=lambda uses: sum(map(len, uses.values())), default=before)

    def visit_Assign(self, node: ast.Assign) -> None:
        self.visit(node.value)
        for target in node.targets:
            for part in ast.walk(target):
                if isinstance(part, ast.Name | ast.Attribute):
                    self.uses.pop(ast.unparse(part), None)

    def _visit_inner(self, node: ast.FunctionDef | ast.Lambda) -> None:
        """The arguments of a lambda are different from outer variables with the same names."""
        names = [argument.arg for argument in [*node.args.args, *node.args.kwonlyargs]]
        outside = {name: self.uses.pop(name) for name in names if name in self.uses}
        self.generic_visit(node)
        for name in names:
            self.uses.pop(name, None)
        self.uses |= outside

    visit_FunctionDef = visit_Lambda = _visit_inner

    def visit_Call(self, node: ast.Call) -> None:
        self.generic_visit(node)
        how = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if how in _LOOKS or how[:1].isupper():  # a class that stores the key does not use it yet
            return
        for argument in [*node.args, *(keyword.value for keyword in node.keywords)]:
            name = ast.unparse(argument)
            if isinstance(argument, ast.Name | ast.Attribute | ast.Subscript) and name.split("[")[0].endswith("key"):
                self.uses[name].append(how)
                if len(self.uses[name]) > 1 and set(self.uses[name]) != {"fold_in"}:
                    self.found.append(f"line {node.lineno}: {name} goes to {' and '.join(self.uses[name])}")


@pytest.mark.parametrize(
    ("body", "wrong"),
    [
        ("a, b = split(key)\n return uniform(a), uniform(b)", 0),
        ("return fold_in(key, 1), fold_in(key, 2)", 0),
        ("key, now = split(key)\n return uniform(now), uniform(key)", 0),
        ("if a:\n  return uniform(key)\n return normal(key)", 0),
        ("a, b = split(key, 3)[:2]\n return uniform(fold_in(key, 1))", 1),
        ("begin(key)\n return uniform(key)", 1),
        ("x = uniform(state.key)\n return x + normal(state.key)", 1),
        ("return uniform(keys[0]), [draw(test_key), fold_in(test_key, 0)]", 1),
    ],
)
def test_rule_finds_reused_keys(body, wrong):
    assert len(reuses(f"def f(key, test_key, state, a):\n {body}")) == wrong


# These use the same randomness twice on purpose.
_ON_PURPOSE = {
    "policy_key": "temperature and policy are judged by the same actions, which XLA then computes once",
    "test_key": "every test of a controller in training is the same test",
}


@pytest.mark.parametrize("file", SOURCES, ids=lambda file: str(file.relative_to(ROOT)))
def test_keys_are_used_once(file):
    found = reuses(file.read_text("utf-8"))
    assert [use for use in found if not any(f" {name} goes" in use for name in _ON_PURPOSE)] == []
