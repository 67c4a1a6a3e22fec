"""``dsffnet transfer``: pose a mesh, or a sequence of meshes, like another."""

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from datagen.common.errors import RecipeError
from datagen.common.printable import printable
from datagen.common.resources import memory_errors
from training.tracking.record import Server
from workflows.cli.declare import Command, Parser, add_checkpoint_option
from workflows.pipeline.console import print_note, print_text, server_of

_OWN_STORE = Path("runs/quickstart/mlflow.db")


def _transfer_options(made: Parser) -> None:
    made.add_argument("paths", nargs="*", metavar="SOURCE TARGET", help="short for --source and --target")
    add_model_option(made)
    add_checkpoint_option(made)
    made.add_argument("--source", metavar="A", help="mesh in the wanted pose, or frames: a folder, a pattern (w*.obj)")
    made.add_argument("--target", metavar="B", help="mesh of the wanted identity")
    made.add_argument("--out", "-o", required=True, metavar="C", help="mesh to write; for frames a folder, or one .glb")
    for whose in ("source", "target"):
        made.add_argument(
            f"--{whose}-geometry",
            action="append",
            default=[],
            metavar="NAME",
            help=f"geometries (GLB), groups or objects (OBJ) of the {whose} to take, one each time (all)",
        )
    made.add_argument("--force", action="store_true", help="without --model: pose even a person like an animal")
    _add_standing(made)
    made.add_argument(
        "--animation",
        metavar="NAME",
        help="of a GLB as source: every frame of its animation of that name, --fps a second",
    )
    _add_extras(made)
    made.add_argument("--tracking-uri", metavar="URI", help="MLflow server of models:/ (default: MLFLOW_TRACKING_URI)")


def add_model_option(made: Parser) -> None:
    """--model."""
    made.add_argument(
        "--model",
        metavar="RUN",
        help="run folder, weights, models:/NAME@ALIAS (MLflow), or what comes along: human, dressed (people in "
        "wide clothes), animals, dsffnet-people (default: one of the first three, by the meshes)",
    )


def _add_standing(made: Parser) -> None:
    made.add_argument("--align", action="store_true", help="find by the network how each mesh stands, and turn it")
    made.add_argument("--up", metavar="AXIS", help="towards the head: X Y Z -X -Y -Z (Y), or two: SOURCE,TARGET")
    made.add_argument("--front", metavar="AXIS", help="where the body faces (Z; -Y if Z is up), or two: SOURCE,TARGET")


def _add_extras(made: Parser) -> None:
    made.add_argument(
        "--refine", action="store_true", help="pull the edges back to the target's (see docs/transfer.md)"
    )
    made.add_argument(
        "--project", metavar="NAME", help="fit the target's rigid parts to the output: as the weights human see them"
    )
    made.add_argument("--smooth", default="0", metavar="N|0.2s", help="smooth a sequence over N frames or a time (off)")
    made.add_argument("--fps", type=rate, default=30.0, metavar="N", help="frames a second of a sequence (30)")
    made.add_argument("--picture", action="store_true", help="write a PNG of source, target and output beside C")
    made.add_argument("--viewer", action="store_true", help="write a page to turn them in (HTML) beside C")


def transfer_command(options: argparse.Namespace) -> None:
    """Pose one mesh like another, or like each of a sequence.

    examples:
      dsffnet transfer pose.obj person.glb -o posed.glb --picture --viewer
      dsffnet transfer walk/ person.glb -o walking.glb --smooth 7
      dsffnet transfer character.glb person.glb --animation Walk -o walking.glb
      dsffnet transfer --model runs/quickstart/beside --source pose.obj --target person.obj --out posed.obj
      dsffnet transfer scan.ply person.obj -o posed.obj --model models:/dsffnet@latest-trained --align --refine
    """
    from datagen.characters.motion import animation_names
    from datagen.mesh.geometries import listed
    from workflows.transfer.job import TransferJob

    job = TransferJob.from_options(options)
    job.check_places()
    source, target = job.read_source(0), job.read_target()
    job.check_textures(source, target)
    for mesh, option in ((source, "--source-geometry"), (target, "--target-geometry")):
        if len(mesh.geometries) > 1:
            taken = f"{mesh.path}: {listed(mesh.geometries)} as one body ({option} chooses among them)"
            print_text(printable(taken))
    animations = animation_names(job.sources[0]) if job.animation is None and not job.is_sequence else ()
    if animations:
        print_text(
            printable(f"{source.path} is taken at rest; --animation NAME poses every frame of {listed(animations)}")
        )
    with (
        weights_of(options) as weights,
        memory_errors("Nothing was written over; decimate the meshes (docs/transfer.md says what they take)"),
    ):
        print_note("loading the network ...")
        from workflows.transfer.run import TransferWork

        work = TransferWork.of(job, weights, first=source.mesh, target=target, force=options.force)
        print_text(printable(work.run()))


@contextmanager
def weights_of(options: argparse.Namespace) -> Iterator[Path | None]:
    """The folder or file of the weights that ``--model`` names, None where it names none.

    Raises
    ------
    CheckpointError
        There are none, or they are damaged.
    RegistryError
        MLflow does not have that model.
    """
    if options.model is None:
        if options.checkpoint != "result":
            raise RecipeError("--checkpoint is one of a run's: add --model RUN")
        yield None
        return
    if options.force:
        raise RecipeError("--force is for weights that are chosen by the meshes: leave it out, or --model")
    if not options.model.startswith("models:/"):
        from workflows.pipeline.weights_argument import evaluated, weights_called

        yield evaluated(weights_called(options.model, option="--model"), options.checkpoint).weights
        return
    from training.inference.registered_model import download_weights

    with tempfile.TemporaryDirectory(prefix="dsffnet-") as folder:
        server = _server(options.tracking_uri)
        yield download_weights(options.model, server.uri, Path(folder), own=server.own)


def _server(asked: str | None) -> Server:
    """The server of registered models: as asked, as the environment says, or the quickstart's own store."""
    server = server_of(_OWN_STORE.parent, asked)
    if server.own and not _OWN_STORE.is_file():
        raise RecipeError("models:/ needs an MLflow server: add --tracking-uri URI, or set MLFLOW_TRACKING_URI")
    return server


def rate(word: str) -> float:
    """Frames a second, as they come from a command line."""
    value = float(word)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{word!r} is not a number above 0")
    return value


COMMAND = Command(transfer_command, _transfer_options)
