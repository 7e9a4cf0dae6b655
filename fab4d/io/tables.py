"""TOML tables read strictly: every key is known, present where needed, and of the right kind and range."""

import difflib
import math
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fab4d.errors import SceneError

Parser = Callable[[Any], Any]


class Key(NamedTuple):
    """What a table may hold under a key: how the value is parsed, and whether it must be there."""

    parse: Parser
    required: bool = False


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file. Raises SceneError when it is missing, no text, or no TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        msg = f"{path}: cannot be read ({error.strerror}); give a TOML file or a folder that holds scene.toml"
        raise SceneError(msg) from error
    except UnicodeDecodeError as error:
        msg = f"{path}: byte {error.start} is not UTF-8: save the file as UTF-8 text"
        raise SceneError(msg) from error
    except tomllib.TOMLDecodeError as error:
        msg = f"{path}: not valid TOML: {error}"
        raise SceneError(msg) from error


def read_keys(table: Any, keys: Mapping[str, Key], where: str) -> dict[str, Any]:
    """The parsed values of the keys that `table` has.

    where : file and section, which start every message.
    Raises SceneError for an unknown key (naming the nearest known one), a missing key or a wrong value.
    """
    if not isinstance(table, dict):
        msg = f"{where} must be a table of keys, not {_shown(table)}"
        raise SceneError(msg)
    for name in table:
        if name not in keys:
            raise SceneError(_unknown_key(name, list(keys), where))
    for name, key in keys.items():
        if key.required and name not in table:
            msg = f'{where}: the key "{name}" is missing'
            raise SceneError(msg)
    return {name: parsed(value, keys[name].parse, f"{where} {name}") for name, value in table.items()}


def parsed(value: Any, parse: Parser, where: str) -> Any:
    """`parse(value)`, whose ValueError (what was expected) becomes a SceneError with place and value."""
    try:
        return parse(value)
    except ValueError as error:
        msg = f"{where} must be {error}, not {_shown(value)}"
        raise SceneError(msg) from error


def nearest(name: str, known: list[str]) -> str:
    """How a message goes on after an unknown name: the nearest known one, or all of them."""
    by_lower_case = {word.lower(): word for word in known}
    close = difflib.get_close_matches(name.lower(), by_lower_case, n=1, cutoff=0.5)
    return f'did you mean "{by_lower_case[close[0]]}"?' if close else f"known: {', '.join(known)}"


def _unknown_key(name: str, known: list[str], where: str) -> str:
    return f'{where}: unknown key "{name}"; {nearest(name, known)}'


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 80 else text[:76] + " ..."


def text(value: Any) -> str:
    """A non-empty line of text."""
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        msg = "a line of text"
        raise ValueError(msg)
    return value


def flag(value: Any) -> bool:
    """true or false."""
    if not isinstance(value, bool):
        msg = "true or false"
        raise ValueError(msg)
    return value


def number(value: Any, expected: str = "a finite number") -> float:
    """A finite number; TOML's true and false are none."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(expected)
    return float(value)


def in_range(low: float, high: float, *, open_low: bool = False) -> Parser:
    """Parser of numbers in [low, high], or in (low, high] with `open_low`."""
    above = "above" if open_low else "from"
    expected = f"a number {above} {low:g}" + (f" to {high:g}" if math.isfinite(high) else " up")

    def parse(value: Any) -> float:
        x = number(value, expected)
        if not (low <= x <= high) or (open_low and x == low):
            raise ValueError(expected)
        return x

    return parse


positive = in_range(0, math.inf, open_low=True)
non_negative = in_range(0, math.inf)
fraction = in_range(0, 1)


def direction(value: Any) -> tuple[float, float, float]:
    """A list of three numbers, not all zero, as a unit vector."""
    x, y, z = list_of(number, 3)(value)
    length = math.hypot(x, y, z)
    if length == 0:
        msg = "a direction, three numbers that are not all zero"
        raise ValueError(msg)
    return x / length, y / length, z / length


def whole(low: int) -> Parser:
    """Parser of whole numbers from `low` up."""
    expected = f"a whole number from {low} up"

    def parse(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or value < low:
            raise ValueError(expected)
        return value

    return parse


def one_of(*choices: str) -> Parser:
    """Parser of one of some words."""

    def parse(value: Any) -> str:
        if value not in choices:
            msg = " or ".join(f'"{choice}"' for choice in choices)
            raise ValueError(msg)
        return str(value)

    return parse


def list_of(parse_item: Parser, count: int | None = None) -> Parser:
    """Parser of a list (of `count` items) as a tuple; an empty list is refused."""
    expected = f"a list of {count}" if count else "a list that is not empty"

    def parse(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list) or not value or (count and len(value) != count):
            raise ValueError(expected)
        try:
            return tuple(parse_item(item) for item in value)
        except ValueError as error:
            msg = f"{expected}, each {error}"
            raise ValueError(msg) from error

    return parse
