"""Write the sample scenes: `python samples/make.py [NAME ...] [--all] [--out FOLDER]`."""

import argparse
from pathlib import Path

from shapes.catalogue import COMMITTED, SAMPLES
from shapes.scene import write_sample


def chosen_names(names: list[str], everything: bool) -> list[str]:
    """The samples asked for; without a name those that are committed."""
    return names or list(SAMPLES if everything else COMMITTED)


def main() -> None:
    """Parse the command line and write the samples."""
    parser = argparse.ArgumentParser(description="Write the sample scenes.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(SAMPLES)}")
    parser.add_argument("--all", action="store_true", help="also the scenes whose meshes are not committed")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder to write the samples into")
    args = parser.parse_args()
    if unknown := [name for name in args.names if name not in SAMPLES]:
        parser.error(f"no sample {unknown[0]!r}; there are {', '.join(SAMPLES)}")
    for name in chosen_names(args.names, args.all):
        sample = SAMPLES[name]()
        write_sample(args.out / name, name, sample)
        print(f"{args.out / name}: {len(sample.X)} vertices, {len(sample.tets)} tets")


if __name__ == "__main__":
    main()
