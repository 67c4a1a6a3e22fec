"""``dsffnet avatar``: a person in clothes, learned from posed scans, evaluated and animated."""

import argparse
from pathlib import Path

from datagen.common.errors import RecipeError
from workflows.cli.declare import (
    Command,
    Parser,
    add_fresh_option,
    add_local_option,
    add_set_option,
    add_tracking_option,
    add_yes_option,
)
from workflows.cli.transfer import rate


def _options(made: Parser) -> None:
    kinds = made.add_subparsers(required=True, metavar="train|evaluate|animate", dest="what")
    _train_options(kinds.add_parser("train", help="scans, templates, points, evaluation; again to resume"))
    _evaluate_options(kinds.add_parser("evaluate", help="measure and draw a trained avatar again"))
    _animate_options(kinds.add_parser("animate", help="an avatar on its way through poses, as an animated GLB"))


def _train_options(made: Parser) -> None:
    from workflows.avatar.recipe import known_avatars

    names = ", ".join(known_avatars())
    made.add_argument("--recipe", default="avatar-small", metavar="NAME|FILE", help=f"a YAML file, or one of {names}")
    made.add_argument(
        "--people", nargs="+", default=[], metavar="FILE.npz",
        help="scans of your own, a file a person in an outfit (docs/avatar.md), in the place of the recipe's data",
    )  # fmt: skip
    add_set_option(made)
    made.add_argument("--out", metavar="DIR", help="folder for everything (default runs/RECIPE)")
    add_tracking_option(made)
    add_fresh_option(made, "what DIR holds of this")
    add_yes_option(made)
    add_local_option(made)
    made.add_argument("--help-all", action=_Keys, nargs=0, help="all keys for --set, with the values of avatar-small")
    made.set_defaults(work=_train)


class _Keys(argparse.Action):
    """Print the keys of a recipe, and end."""

    def __call__(self, parser: Parser, *_: object) -> None:
        from workflows.avatar.recipe import AvatarWorkflow, load_avatar
        from workflows.pipeline.console import print_text
        from workflows.recipe.loader import describe_fields

        print_text("\n".join(describe_fields(AvatarWorkflow, recipe=load_avatar("avatar-small"))))
        parser.exit()


def _evaluate_options(made: Parser) -> None:
    _add_folder(made)
    made.add_argument("--frames", type=int, metavar="N", help="poses of each kind and outfit (default: the recipe's)")
    made.set_defaults(work=_evaluate)


def _animate_options(made: Parser) -> None:
    _add_folder(made)
    add = made.add_argument
    add("--outfit", metavar="NAME", help="which one, where there are several")
    add("--poses", type=Path, metavar="FILE.npz", help="poses, joints, parents (docs/importing.md); default: a walk")
    add("--source", type=Path, metavar="MESH", help="a person to move like: a mesh, a folder or a pattern of frames")
    add("--stations", type=int, default=5, metavar="N", help="random poses that a walk goes through (default 5)")
    add("--seed", type=int, default=0, help="of these poses")
    add("--fps", type=rate, default=24.0, help="frames a second (default 24)")
    add("--picture", type=Path, metavar="FILE.png", help="a picture of ten of the frames")
    add("-o", "--out", type=Path, required=True, metavar="FILE.glb", help="the animation")
    made.set_defaults(work=_animate)


def _add_folder(made: Parser) -> None:
    made.add_argument("folder", type=Path, metavar="DIR", help="folder of dsffnet avatar train")


def avatar_command(options: argparse.Namespace) -> None:
    """Learn a person in clothes from posed scans (FITE), and animate them.

    examples:
      dsffnet avatar train --recipe avatar-small --out runs/avatar
      dsffnet avatar train --people ann.npz --out runs/ann
      dsffnet avatar animate runs/avatar --outfit skirt -o walk.glb --picture walk.png
      dsffnet avatar animate runs/avatar --outfit skirt -o like.glb --source person.obj
      dsffnet avatar evaluate runs/avatar --frames 16
    """
    options.work(options)


def _train(options: argparse.Namespace) -> None:
    from datagen.common.files import read_text_within
    from workflows.avatar.outfits import require_people
    from workflows.avatar.recipe import load_avatar
    from workflows.avatar.run import run_avatar
    from workflows.pipeline.console import at_work, print_text
    from workflows.pipeline.ray_cluster import require_reachable
    from workflows.pipeline.run_folder import AvatarFolder
    from workflows.pipeline.tasks import TaskRunner

    recipe = load_avatar(
        options.recipe,
        options.set,
        people=[require_reachable(its, option="--people") for its in options.people],
    )
    out = Path(require_reachable(options.out or f"runs/{Path(options.recipe).stem}", option="--out"))
    folder = AvatarFolder(out)
    folder.require_kind()
    require_people(recipe, folder, fresh=options.fresh)
    with at_work(options, folder, recipe.data, local=options.local):
        run_avatar(recipe, out, TaskRunner(local=options.local))
    print_text(
        f"{read_text_within(folder.evaluation.path, 'tables.md')}\n"
        f"  picture       {folder.evaluation.examples}\n"
        f"  animate it    dsffnet avatar animate {out} -o walk.glb --picture walk.png"
    )


def _evaluate(options: argparse.Namespace) -> None:
    from workflows.avatar.evaluate import evaluate_avatar, require_avatar
    from workflows.avatar.recipe import load_avatar
    from workflows.pipeline.console import print_text
    from workflows.pipeline.run_folder import AvatarFolder
    from workflows.pipeline.stage import mark_of

    folder = AvatarFolder(options.folder)
    require_avatar(folder)
    changes = [] if options.frames is None else [f"evaluation.frames={options.frames}"]
    with folder.alone():
        if changes:
            mark_of(folder.path, "evaluate").unlink(missing_ok=True)
        evaluate_avatar(load_avatar(str(folder.recipe), changes), folder)
    print_text(folder.evaluation.tables.read_text(encoding="utf-8"))


def _animate(options: argparse.Namespace) -> None:
    from workflows.avatar.animate import animate, poses_of
    from workflows.pipeline.run_folder import AvatarFolder

    if options.seed < 0:
        raise RecipeError(f"--seed {options.seed}: a seed is 0 or more")
    if options.stations < 2:
        raise RecipeError(f"--stations {options.stations}: a walk needs two poses or more")
    folder = AvatarFolder(options.folder)
    poses = poses_of(folder, options.poses, options.source, count=options.stations, seed=options.seed)
    animate(folder, options.outfit, poses, options.out, frames_per_second=options.fps, picture=options.picture)


COMMAND = Command(avatar_command, _options)
