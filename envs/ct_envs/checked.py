"""Settings that are checked where they are built, whoever builds them: Python, the command line or a file.

A config is a frozen dataclass that derives from ``Checked``; its annotations say what each setting may be::

    @dataclass(frozen=True)
    class ModelConfig(Checked):
        layers: Annotated[int, Within(1, 64)] = 4
        frame: Literal["world", "heading"] = "world"
        speed_mps: Annotated[float, Above(0, 100)] | None = None
        hidden: Annotated[tuple[Annotated[int, Within(1, 8192)], ...], Within(1, 16)] = (256, 256)  # 1 to 16 entries

What two settings must agree in, a config checks in its own ``__post_init__``, after that of ``super()``.
"""

import functools
import sys
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from ct_envs.errors import UserError

_SHOWN = 60  # characters of a value that an error shows
_LONGEST_TEXT = 4096
Config = TypeVar("Config", bound="Checked")


@dataclass(frozen=True)
class Within:
    """A number from ``low`` to ``high``, or a tuple of so many entries."""

    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Whether the number is one of these; NaN never is."""
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return f"from {_plain(self.low)} to {_plain(self.high)}"


@dataclass(frozen=True)
class Above(Within):
    """A number above ``low``, at most ``high``."""

    def holds(self, value: float) -> bool:
        """Whether the number is one of these; NaN never is."""
        return self.low < value <= self.high

    def __str__(self) -> str:
        return f"above {_plain(self.low)}, at most {_plain(self.high)}"


_FINITE = Within(-sys.float_info.max, sys.float_info.max)
Share = Annotated[float, Within(0, 1)]
Count = Annotated[int, Within(1, 10**9)]


class Checked:
    """A config whose settings are checked when it is made, by ``dataclasses.replace``, too. Raises UserError."""

    def __post_init__(self) -> None:
        for name, hint in _hints(type(self)).items():
            wanted = _wanted(hint, getattr(self, name))
            if wanted:
                raise UserError(f"{type(self).__name__}.{name} is {shown(getattr(self, name))}; give {wanted}")


def from_json(kind: type[Config], values: Any, where: str) -> Config:
    """The config that ``dataclasses.asdict`` and JSON made ``values`` of; a setting that is missing has its default.

    Args:
        where: what the errors call it, such as "settings".

    Raises:
        UserError: a setting out of its range, one that is unknown, or a missing config, which is named.
    """
    if not isinstance(values, dict):
        raise UserError(f"{where} is {shown(values)}; give an object with the settings of a {kind.__name__}")
    hints, built = _hints(kind), {}
    for name in values:
        if name not in hints:
            raise UserError(f"{where} of another version: this one knows no '{shown(name, quoted=False)}'")
    for name, hint in hints.items():
        if name in values:
            built[name] = _read(hint, values[name], f"{where}.{name}")
        elif _is_config(hint):
            raise UserError(f"{where} of another version: '{name}' is missing")
    try:
        return kind(**built)
    except UserError as bad:
        raise UserError(f"{where}: {bad}") from None


def _read(hint: Any, value: Any, where: str) -> Any:
    """A setting as its config wants it: a tuple for a list, a config for an object."""
    config = next((part for part in (hint, *get_args(hint)) if _is_config(part)), None)
    if config is not None and not (value is None and _takes_none(hint)):
        return from_json(config, value, where)
    if isinstance(value, list):
        value = tuple(value)
    wanted = _wanted(hint, value)
    if wanted:
        raise UserError(f"{where} is {shown(value)}; give {wanted}")
    return value


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    """The annotations of a config's settings."""
    return get_type_hints(kind, include_extras=True)


def _is_config(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, Checked)


def _takes_none(hint: Any) -> bool:
    return NoneType in get_args(hint)


def _wanted(hint: Any, value: Any) -> str:
    """What a value should be instead; empty if it is that."""
    bounds = None
    if get_origin(hint) is Annotated:
        hint, *notes = get_args(hint)
        bounds = next((note for note in notes if isinstance(note, Within)), None)
    if get_origin(hint) in (Union, UnionType):
        answers = [_wanted(kind, value) for kind in get_args(hint)]
        return "" if "" in answers else " or ".join(answers)
    if get_origin(hint) is Literal:
        choices = get_args(hint)
        return "" if isinstance(value, str) and value in choices else f"one of {', '.join(choices)}"
    if get_origin(hint) is tuple:
        return _wanted_tuple(get_args(hint), bounds, value)
    if hint in (int, float):
        # True and False are no numbers here.
        right = isinstance(value, int if hint is int else (int, float)) and not isinstance(value, bool)
        name = "a whole number" if hint is int else "a number"
        holds = right and (bounds or _FINITE).holds(value)
        return "" if holds else f"{name} {bounds or ''}".rstrip()
    if hint is str:
        usable = isinstance(value, str) and len(value) <= _LONGEST_TEXT and value.isprintable()
        return "" if usable else "a line of text"
    names = {bool: "True or False", NoneType: "None"}
    return "" if isinstance(value, hint) else names.get(hint, f"a {hint.__name__}")


def _wanted_tuple(kinds: tuple[Any, ...], bounds: Within | None, value: Any) -> str:
    """``_wanted`` of a tuple with entries of these kinds; the last may be an ellipsis."""
    alike = kinds[-1] is Ellipsis
    size = bounds or Within(0, 1000) if alike else Within(len(kinds), len(kinds))
    of = [kinds[0]] * len(value) if isinstance(value, tuple) and alike and size.holds(len(value)) else kinds
    if isinstance(value, tuple) and size.holds(len(value)):
        wrong = next((wanted for kind, entry in zip(of, value, strict=True) if (wanted := _wanted(kind, entry))), "")
        return f"for each entry {wrong}" if wrong else ""
    return f"a tuple of {_plain(size.low)} entries" if size.low == size.high else f"a tuple of entries, {size} of them"


def _plain(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:g}"


def shown(value: Any, *, quoted: bool = True) -> str:
    """A value as an error may show it: short, on one line, whatever it is."""
    try:
        text = repr(value) if quoted or not isinstance(value, str) else repr(value)[1:-1]
    except (ValueError, RecursionError):  # an integer of thousands of digits, or a list in a list in a list ...
        return f"a {type(value).__name__} too large to be shown"
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 4]} ..."
