"""What tables and figures call a network."""

from training.evaluation import paper_numbers as paper
from training.recipes.training import CoreNet3dRecipe, NetworkRecipe, NptRecipe


def method_name(network: NetworkRecipe) -> str:
    """What tables call a network, by its recipe: the paper's name, with what is left out or differs behind it."""
    if isinstance(network, CoreNet3dRecipe):
        return paper.CORENET3D
    if isinstance(network, NptRecipe):
        return paper.NPT if network.variant == "maxpool" else f"{paper.NPT} {network.variant}"
    if not network.feature_fusion:
        return f"{paper.DSFFNET} {paper.WITHOUT_FUSION}"
    return paper.DSFFNET if network.target_side else f"{paper.DSFFNET} {paper.WITHOUT_TARGET_SIDE}"


def needs_equal_counts(network: NetworkRecipe) -> bool:
    """Whether a network pairs source and target by index, so that both must have as many vertices."""
    return isinstance(network, NptRecipe) and network.variant == "origin"
