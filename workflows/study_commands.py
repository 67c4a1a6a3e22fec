"""The subcommands of ``dsffnet`` that train or probe many: sweep, compare, ablation, robustness, generalisation."""

import argparse

from workflows.commands import Command, add_command
from workflows.comparison_command import ablation_command, add_comparison_options, compare_command
from workflows.comparison_plan import Kind
from workflows.generalisation_command import EXAMPLES as GENERALISATION_EXAMPLES
from workflows.generalisation_command import add_generalisation_options, generalisation_command
from workflows.robustness_command import EXAMPLES as ROBUSTNESS_EXAMPLES
from workflows.robustness_command import add_robustness_options, robustness_command
from workflows.sweep_command import add_sweep_options, sweep_command

_EXAMPLES: dict[Command, str] = {
    sweep_command: "  dsffnet sweep --trials networks --out runs/networks",
    compare_command: """\
  dsffnet compare --out runs/compare
  dsffnet compare --recipe animals-small --set training.steps=500""",
    ablation_command: "  dsffnet ablation --out runs/ablation",
}
_COMPARED: dict[Command, Kind] = {compare_command: "comparison", ablation_command: "ablation"}


def add_study_commands(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Declare them and their options."""
    add_sweep_options(add_command(commands, sweep_command, _EXAMPLES[sweep_command], takes_recipe=True))
    for compared, kind in _COMPARED.items():
        add_comparison_options(add_command(commands, compared, _EXAMPLES[compared], takes_recipe=True), kind)
    add_robustness_options(add_command(commands, robustness_command, ROBUSTNESS_EXAMPLES))
    add_generalisation_options(add_command(commands, generalisation_command, GENERALISATION_EXAMPLES))
