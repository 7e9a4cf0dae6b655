"""Where the data that ships with fab4d lies."""

from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]


def data_folder(name: str) -> Path:
    """The folder `pipeline` or `profiles`: inside the package when installed from a wheel, beside it in a checkout.

    Raises FileNotFoundError when it is in neither place.
    """
    for folder in (PACKAGE / name, PACKAGE.parent / name):
        if folder.is_dir():
            return folder
    msg = f'no data folder "{name}" in or beside {PACKAGE}: fab4d is not installed completely'
    raise FileNotFoundError(msg)
