"""How trained weights bear a spoilt source mesh: noise, missing parts, other sampling, rotation (the paper's Figure 9).

    python workflows/robustness.py runs/quickstart/run --data runs/quickstart/dataset.zarr
    python workflows/robustness.py runs/dsffnet runs/npt --data X.zarr --out runs/robustness --triples 100

Writes FOLDER/robustness.md (tables), rows.csv, curves.png, noise.png, disturbances.png. Run the same command again to
go on after a stop: what is measured is kept.
"""

import sys
from pathlib import Path

_ROOT = str(Path(__file__).resolve().parents[1])


def main(arguments: list[str] | None = None) -> None:
    """Parse, then measure."""
    import argparse

    from workflows.robustness_command import add_robustness_options, robustness_command

    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_robustness_options(made)
    robustness_command(made.parse_args(arguments))


if __name__ == "__main__":
    if sys.path[0] != _ROOT:  # a script's own folder comes first otherwise, and its files would hide packages
        sys.path[0] = _ROOT
    from workflows.console import guarded

    guarded(main)
