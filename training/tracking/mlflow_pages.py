"""What MLflow's pages show of this project first: the list of runs with its PMD, and how the model is called."""

import json
from typing import Any

from training.tracking.record import ALIAS, MODEL

_VIEW = "dsffnet"
_COLUMNS = ("metrics.`pmd_unseen`", "metrics.`pmd_seen`", "metrics.`millimetres_unseen`", "attributes.`Models`")
_STATE = {"selectedColumns": _COLUMNS, "columnOrder": [], "columnWidths": {}, "runsExpanded": {}}
_SAVED_VIEW = {"name": "PMD", "createdAt": 0, "updatedAt": 0, "state": json.dumps(_STATE)}

EXPERIMENT_TAGS = {
    "mlflow.experimentKind": "custom_model_development",  # training, where MLflow would take it for GenAI
    f"mlflow.sharedViewState.{_VIEW}": json.dumps(_SAVED_VIEW),  # columns of the list, for the address below
}
"""Tags by which MLflow's pages show the experiment as trainings, with columns of PMD."""

MODEL_DESCRIPTION = f"""\
Pose transfer: a source mesh gives the pose, a target mesh the identity. Each version is one training; its description
says on what data, and its PMD. `{ALIAS}` is the newest.

{{call}}"""

_CALL = """\
```python
import mlflow
model = mlflow.pyfunc.load_model("{uri}")
posed = model.predict({{"source": source_vertices, "target": target_vertices, "target_faces": target_faces}})
```

Vertices [n, 3] and [m, 3], triangles [f, 3]; out come the target's vertices [m, 3] in the source's pose. With files:
`dsffnet transfer --model {uri} --source pose.obj --target person.glb --out posed.glb --tracking-uri URI`
"""


def how_to_call(uri: str) -> str:
    """Markdown that says how a registered model, ``models:/NAME/VERSION`` or ``models:/NAME@ALIAS``, is called."""
    return _CALL.format(uri=uri)


def mark_experiment(client: Any, experiment: Any) -> None:
    """Give an experiment those of its tags that it lacks; what people set stays."""
    for key, value in EXPERIMENT_TAGS.items():
        if key not in experiment.tags:
            client.set_experiment_tag(experiment.experiment_id, key, value)


def page_addresses(server: str, experiment: str) -> dict[str, str]:
    """Return the addresses of the runs' and the model's pages of a server ``http://HOST:PORT``."""
    return {
        "runs": f"{server}/#/experiments/{experiment}/runs?workflowType=machine_learning&viewStateShareKey={_VIEW}",
        "model": f"{server}/#/models/{MODEL}",
    }
