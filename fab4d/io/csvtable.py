"""CSV tables: one header line, full double precision, LF line ends, UTF-8."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence

from fab4d.errors import ArtifactError

Cell = str | int | float

# The columns of error-vs-time.csv and of the traces that it is joined from.
TRACE_COLUMNS = (
    "solver",
    "phase",
    "wall_s",
    "tau",
    "rms_mm",
    "max_mm",
    "hausdorff_mm",
    "smp_fraction",
    "forces",
    "ambiguous_fraction",
)


def csv_bytes(columns: Sequence[str], rows: Iterable[Mapping[str, Cell]]) -> bytes:
    """The rows as a CSV file with exactly `columns`. Raises ValueError for a row with other keys."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="raise", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        if missing := [c for c in columns if c not in row]:
            msg = f"a row lacks the columns {', '.join(missing)}"
            raise ValueError(msg)
        writer.writerow({key: _plain(value) for key, value in row.items()})
    return text.getvalue().encode()


def read_csv(data: bytes, columns: Sequence[str], name: str) -> list[dict[str, str]]:
    """The rows of a CSV file with at least `columns`. Raises ArtifactError naming the table and the missing column."""
    reader = csv.DictReader(io.StringIO(data.decode()))
    found = reader.fieldnames or []
    if missing := [c for c in columns if c not in found]:
        has = ", ".join(found) or "none"
        msg = f"{name}: no column {', '.join(missing)}, it has {has}: run the stage that writes it again"
        raise ArtifactError(msg)
    return list(reader)


def _plain(value: Cell) -> Cell:
    """Numbers as Python's own, whose repr is the shortest that reads back equal; -0.0 as 0.0."""
    if isinstance(value, str):
        return value
    number = value.item() if hasattr(value, "item") else value
    return 0.0 if number == 0 and isinstance(number, float) else number
