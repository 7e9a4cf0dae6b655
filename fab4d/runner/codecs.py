"""How an artifact becomes bytes and back, by its suffix: .npz a dict of arrays, .json a dict, others as they are.

Equal values give equal bytes on every machine, for the runner compares artifacts by their sha256.
"""

import io
import json
import zipfile
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np


def encode(suffix: str, value: Any) -> bytes:
    """`value` as the bytes of a file. Raises TypeError or ValueError for what the form cannot hold."""
    return _ENCODERS.get(suffix, _checked_bytes)(value)


def decode(suffix: str, data: bytes) -> Any:
    """The value that `encode` made `data` from. Raises ValueError when the bytes are damaged."""
    try:
        return _DECODERS.get(suffix, bytes)(data)
    except (zipfile.BadZipFile, EOFError, KeyError, OSError) as error:
        raise ValueError(str(error)) from error


def _encode_arrays(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in sorted(arrays):
            archive.writestr(_entry(name), _array_bytes(arrays[name]))
    return buffer.getvalue()


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
    entry.create_system = 3  # Unix; the default differs between Windows and Unix
    return entry


def _array_bytes(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def _decode_arrays(data: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return dict(archive)


def _encode_json(value: Mapping[str, Any]) -> bytes:
    return (json.dumps(value, indent=2, allow_nan=False, default=_plain_number, ensure_ascii=False) + "\n").encode()


def _plain_number(value: Any) -> Any:
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    msg = f"a report cannot hold {type(value).__name__}"
    raise TypeError(msg)


def _checked_bytes(value: bytes) -> bytes:
    if not isinstance(value, bytes):
        msg = f"expected bytes, not {type(value).__name__}"
        raise TypeError(msg)
    return value


_ENCODERS: dict[str, Callable[[Any], bytes]] = {".npz": _encode_arrays, ".json": _encode_json}
_DECODERS: dict[str, Callable[[bytes], Any]] = {".npz": _decode_arrays, ".json": json.loads}
