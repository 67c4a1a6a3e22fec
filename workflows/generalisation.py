"""How trained weights transfer between bodies and vertex counts that they were not trained on (the paper's Figure 8).

    python workflows/generalisation.py runs/quickstart/run
    python workflows/generalisation.py runs/dsffnet runs/npt --data data/faust.zarr --out runs/generalisation

Makes the same people in the same poses as Anny meshes of 369 to 18,056 vertices, bodies in SMPL's format and animals,
and writes FOLDER/generalisation.md (tables), rows.csv, heat-map.png, examples.png, data/. Run the same command again
to go on after a stop.
"""

import sys
from pathlib import Path

_ROOT = str(Path(__file__).resolve().parents[1])


def main(arguments: list[str] | None = None) -> None:
    """Parse, then measure."""
    import argparse

    from workflows.generalisation_command import add_generalisation_options, generalisation_command

    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_generalisation_options(made)
    generalisation_command(made.parse_args(arguments))


if __name__ == "__main__":
    if sys.path[0] != _ROOT:  # a script's own folder comes first otherwise, and its files would hide packages
        sys.path[0] = _ROOT
    from workflows.console import guarded

    guarded(main)
