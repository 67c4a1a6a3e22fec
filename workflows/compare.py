"""DSFFNet, NPT and 3D-CoreNet under one budget on one dataset: the paper's Tables 1 and 2, and Figure 4.

    python workflows/compare.py                                  # the recipe 'small': 13 minutes on two cores
    python workflows/compare.py --recipe animals-small --out /tmp/animals
    python workflows/compare.py --recipe paper --gpus-per-trial 1
    python workflows/compare.py --set training.steps=500 --out runs/quick
    ray job submit --working-dir . -- python workflows/compare.py --recipe paper --gpus-per-trial 1 --out /data/X

Run the same command again to go on from where it was: what is finished is skipped, what failed is tried again.
OUT/report.html is the result; OUT/trials/METHOD are ordinary run folders.
"""

import sys
from pathlib import Path

_ROOT = str(Path(__file__).resolve().parents[1])


def main(arguments: list[str] | None = None) -> None:
    """Parse, then compare."""
    from workflows.comparison_command import add_comparison_options, compare_command
    from workflows.console import parser

    made = parser(__doc__ or "")
    add_comparison_options(made, "comparison")
    compare_command(made.parse_args(arguments))


if __name__ == "__main__":
    if sys.path[0] != _ROOT:  # a script's own folder comes first otherwise, and its files would hide packages
        sys.path[0] = _ROOT
    from workflows.console import guarded

    guarded(main)
