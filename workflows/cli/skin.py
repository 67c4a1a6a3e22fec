"""``dsffnet skin``: give a mesh around a body a skeleton and smooth skinning weights."""

import argparse
from pathlib import Path

from datagen.common.printable import printable
from workflows.cli.declare import Command, Parser, add_set_option
from workflows.pipeline.console import print_text


def _skin_options(made: Parser) -> None:
    made.add_argument("mesh", nargs="?", type=Path, metavar="MESH", help="what lies around the body at rest: OBJ, ...")
    made.add_argument(
        "--body", required=True, metavar="BODY", help="a family (anny, ...), a rigged model (.glb, .gltf), or a recipe"
    )
    made.add_argument("--identity", type=int, default=0, metavar="I", help="which identity of the body (0)")
    made.add_argument("--out", "-o", type=Path, metavar="RIGGED.glb", help="mesh with skeleton and weights to write")
    made.add_argument("--body-mesh", type=Path, metavar="FILE", help="also write the body at rest, to model around")
    add_set_option(made)


def skin_command(options: argparse.Namespace) -> None:
    """Give a mesh around a body a skeleton and smooth skinning weights, as GLB.

    examples:
      dsffnet skin --body anny --identity 3 --body-mesh body.obj
      dsffnet skin shirt.obj --body anny --identity 3 --out shirt.glb
      dsffnet skin armour.glb --body character.glb --out armour-rigged.glb
    """
    from workflows.transfer.skin import SkinJob

    job = SkinJob(
        options.body, options.set, options.identity, mesh=options.mesh, out=options.out, body_mesh=options.body_mesh
    )
    job.check()
    for line in job.run():
        print_text(printable(line))


COMMAND = Command(skin_command, _skin_options)
