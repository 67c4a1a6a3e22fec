"""The stages of an avatar: scans, outfits, templates, points, evaluation; finished ones are skipped."""

from contextlib import ExitStack
from pathlib import Path

from datagen.common.errors import RecipeError
from training.avatar.outfit import Outfit, outfits_in
from training.avatar.template import extract_template, plainest_pose
from training.tracking.record import has_record
from workflows.avatar.evaluate import evaluate_avatar
from workflows.avatar.outfits import MADE, is_of, make_outfits, sources
from workflows.avatar.recipe import AvatarWorkflow, load_avatar
from workflows.avatar.runs import is_learned, learn, trained
from workflows.pipeline.generate import generate_stage
from workflows.pipeline.run_folder import AvatarFolder
from workflows.pipeline.stage import Stage, begin_workflow, once, run_stage, say
from workflows.pipeline.tasks import TaskRunner


def run_avatar(recipe: AvatarWorkflow, out: Path, tasks: TaskRunner) -> None:
    """All stages of a recipe into the folder ``out``."""
    folder, values = AvatarFolder(out), recipe.model_dump(mode="json")
    of_outfits = [values["data"] or sources(recipe, folder), values["field"], values["scans"]]
    of_templates = [*of_outfits, values["template"], values["cell"]]
    of_points = [*of_templates, values["avatar"]]
    _refuse_conflicts(recipe, folder)
    with ExitStack() as around:
        begin = once(lambda: begin_workflow(around, recipe, folder, tasks))
        made = [generate_stage(recipe.data, folder, tasks)] if recipe.data else []
        stages = (
            *made,
            Stage(
                "outfits",
                depends_on=of_outfits,
                intact=lambda: _are_sound(recipe, folder, *MADE),
                work=lambda: make_outfits(recipe, folder, tasks),
            ),
            Stage(
                "templates",
                depends_on=of_templates,
                intact=lambda: _are_sound(recipe, folder, "template"),
                work=lambda: _learn_templates(recipe, folder, tasks),
            ),
            Stage(
                "avatar",
                depends_on=of_points,
                intact=lambda: is_learned(recipe.avatar, folder.outfits, folder.run),
                work=lambda: learn(recipe.avatar, folder.outfits, folder.run, parent=out, tasks=tasks, name="avatar"),
            ),
            Stage(
                "evaluate",
                depends_on=[*of_points, values["evaluation"]],
                intact=lambda: folder.evaluation.tables.exists() and has_record(folder.evaluation.path),
                work=lambda: evaluate_avatar(recipe, folder),
            ),
        )
        for stage in stages:
            run_stage(stage, out=out, before=begin)


def _refuse_conflicts(recipe: AvatarWorkflow, folder: AvatarFolder) -> None:
    """Refuse a recipe that another one's work lies in the folder of, before anything there is touched.

    Raises
    ------
    RecipeError
        What is made or learned would differ; how often to log, where to run and what to evaluate may.
    """
    if not folder.recipe.exists():
        return
    there = load_avatar(str(folder.recipe))
    changed = [name for name in ("data", "field", "scans", "cell") if getattr(recipe, name) != getattr(there, name)]
    if [Path(path).name for path in recipe.people] != [Path(path).name for path in there.people]:
        changed.append("people")
    if changed:
        raise RecipeError(
            f"{folder.path} was made by another recipe: {', '.join(changed)} differ. Choose another --out, or add "
            "--fresh to start over"
        )
    recipe.template.require_same_learning(there.template, where=str(folder.path), section="template")
    recipe.avatar.require_same_learning(there.avatar, where=str(folder.path), section="avatar")


def _are_sound(recipe: AvatarWorkflow, folder: AvatarFolder, *files: str) -> bool:
    outfits = {Outfit(folder.outfits / name): source for name, source in sources(recipe, folder).items()}
    return all(is_of(its, source) and getattr(its, file).is_sound for its, source in outfits.items() for file in files)


def _learn_templates(recipe: AvatarWorkflow, folder: AvatarFolder, tasks: TaskRunner) -> None:
    for outfit in outfits_in(folder.outfits):
        run = folder.template(outfit.name)
        learn(recipe.template, outfit.path, run, parent=folder.path, tasks=tasks, name=f"template {outfit.name}")
        network = trained(recipe.template, outfit.path, run, section="template")
        samples = outfit.samples.load()
        template = extract_template(
            network, plainest_pose(samples.conditions[samples.seen]), outfit.field.load(), cell=recipe.cell
        )
        template.save(outfit.template.path)
        say(
            f"template of {outfit.name}: {len(template.vertices):,} points, Euler characteristic "
            f"{template.euler_characteristic}"
        )
