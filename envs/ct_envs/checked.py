"""Settings that are checked when they are created: from Python, from the command line, or from a file.

A config is a frozen dataclass that derives from ``Checked``. Its annotations give the type and range of each setting::

    @dataclass(frozen=True)
    class ModelConfig(Checked):
        layers: Annotated[int, Within(1, 64)] = 4
        frame: Literal["world", "heading"] = "world"
        speed_mps: Annotated[float, Above(0, 100)] | None = None
        hidden: Annotated[tuple[Annotated[int, Within(1, 8192)], ...], Within(1, 16)] = (256, 256)  # 1 to 16 entries

A config checks conditions on several settings in its own ``__post_init__``, after that of ``super()``.
"""

import functools
import sys
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from ct_envs.errors import UserError

_SHOWN = 60  # maximum number of characters of a value in an error
_LONGEST_TEXT = 4096
Config = TypeVar("Config", bound="Checked")


@dataclass(frozen=True)
class Within:
    """A number from ``low`` to ``high``, or a tuple with that number of entries."""

    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Whether the number is in the range; False for NaN."""
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return f"from {_plain(self.low)} to {_plain(self.high)}"


@dataclass(frozen=True)
class Above(Within):
    """A number above ``low``, at most ``high``."""

    def holds(self, value: float) -> bool:
        """Whether the number is in the range; False for NaN."""
        return self.low < value <= self.high

    def __str__(self) -> str:
        return f"above {_plain(self.low)}, at most {_plain(self.high)}"


_FINITE = Within(-sys.float_info.max, sys.float_info.max)
Share = Annotated[float, Within(0, 1)]
Count = Annotated[int, Within(1, 10**9)]


class Checked:
    """A config whose settings are checked when it is created, also by ``dataclasses.replace``. Raises UserError."""

    def __post_init__(self) -> None:
        for name, hint in _hints(type(self)).items():
            wanted = _wanted(hint, getattr(self, name))
            if wanted:
                raise UserError(f"{type(self).__name__}.{name} is {shown(getattr(self, name))}; give {wanted}")


def from_json(kind: type[Config], values: Any, where: str) -> Config:
    """A config from JSON values, as written from ``dataclasses.asdict``. Missing settings have their defaults.

    Args:
        where: name of the config in errors, such as "settings".

    Raises:
        UserError: a setting is unknown or out of its range, or a config in this config is missing.
    """
    if not isinstance(values, dict):
        raise UserError(f"{where} is {shown(values)}; give an object with the settings of a {kind.__name__}")
    hints, built = _hints(kind), {}
    for name in values:
        if name not in hints:
            raise UserError(f"{where} of another version: '{shown(name, quoted=False)}' is unknown")
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
    """A setting from its JSON value: a list becomes a tuple, and an object becomes a config."""
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
    """A description of the allowed values; empty if the value is allowed."""
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
        # True and False do not count as numbers.
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
    """``_wanted`` for a tuple with entries of these kinds. The last kind may be an ellipsis."""
    alike = kinds[-1] is Ellipsis
    size = bounds or Within(0, 1000) if alike else Within(len(kinds), len(kinds))
    of = [kinds[0]] * len(value) if isinstance(value, tuple) and alike and size.holds(len(value)) else kinds
    if isinstance(value, tuple) and size.holds(len(value)):
        wrong = next((wanted for kind, entry in zip(of, value, strict=True) if (wanted := _wanted(kind, entry))), "")
        return f"for each entry {wrong}" if wrong else ""
    low, high = _plain(size.low), _plain(size.high)
    return f"a tuple of {low} entries" if low == high else f"a tuple of {low} to {high} entries"


def _plain(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:g}"


def shown(value: Any, *, quoted: bool = True) -> str:
    """Any value as a short text of one line, for errors."""
    try:
        text = repr(value) if quoted or not isinstance(value, str) else repr(value)[1:-1]
    except (ValueError, RecursionError):  # an integer with thousands of digits, or a deeply nested list
        return f"too large to be shown ({type(value).__name__})"
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 4]} ..."
