"""Numbers and words as they are printed for people."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray


def printable(words: str) -> str:
    """`words` with what the standard fonts lack replaced by question marks."""
    return words.encode("cp1252", "replace").decode("cp1252")


def number(value: float, decimals: int = 1) -> str:
    """`value` with fixed decimals, never "-0.0"."""
    words = f"{value:.{decimals}f}"
    return words.lstrip("-") if float(words) == 0 else words


def significant(value: float) -> str:
    """`value` to three digits or to the whole number, never with an exponent."""
    digits = 0 if value == 0 else int(np.floor(np.log10(abs(value))))
    return number(value, max(0, 2 - digits))


def triple(vector: FloatArray, decimals: int = 1) -> str:
    return "  ".join(number(v, decimals) for v in vector)


def scale_words(scale: float) -> str:
    """A drawing scale, paper to part: "2.5 : 1" or "1 : 4"."""
    return f"{significant(scale)} : 1" if scale >= 1 else f"1 : {significant(1 / scale)}"


def kelvin(temperature: float) -> str:
    """A temperature in K, with degrees Celsius in brackets."""
    return f"{number(temperature, 0)} K ({number(temperature - 273.15, 0)} °C)"


def plain(value: float) -> str:
    """`value` to four digits, short."""
    return f"{value:.4g}"
