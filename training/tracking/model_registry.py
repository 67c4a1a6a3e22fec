"""A run's weights as a registered model of MLflow: logged with the code that runs them, once."""

import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.common.files import read_within, resolve_within
from training.tracking.record import ALIAS

_ROOT = Path(__file__).parents[2]
_DESCRIPTION = f"""\
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
_NO_CACHES = shutil.ignore_patterns("__pycache__", "*.pyc", "node_modules")


@dataclass(frozen=True)
class Registration:
    """The weights of the record in ``folder``, whose models and versions on the server bear ``marks`` as tags."""

    client: Any
    experiment: str
    run: str
    folder: Path
    marks: dict[str, str]

    def register(self, name: str, *, parent: str | None = None) -> None:
        """Log and register the weights, unless a kill came between that and the note; give them the alias.

        ``parent``: the run that is to show the model, too.
        """
        version = self._registered_version(name)
        if version is None:
            source, model = self._logged_model() or self._log_model()
            if parent:
                self._show_in(parent, model)
            version = self._register_version(name, source, model)
        self.client.set_registered_model_alias(name, ALIAS, version)

    def describe(self, name: str, about: str) -> bool:
        """Give the registered version, if there is one, its description: what is said of it, how it is called."""
        version = self._registered_version(name)
        if version is not None:
            text = f"{about}\n\n{_how_to_call(f'models:/{name}/{version}')}"
            self.client.update_model_version(name, version, description=text)
        return version is not None

    def _show_in(self, run: str, model: str) -> None:
        from mlflow.entities import LoggedModelOutput

        outputs = self.client.get_run(run).outputs
        if model not in [each.model_id for each in (outputs.model_outputs if outputs else ())]:
            self.client.log_outputs(run, [LoggedModelOutput(model, step=0)])

    def _registered_version(self, name: str) -> str | None:
        found = self.client.search_model_versions(f"run_id='{self.run}'")
        same = [each for each in found if each.name == name and self.marks.items() <= each.tags.items()]
        return str(same[0].version) if same else None

    def _logged_model(self) -> tuple[str, str] | None:
        found = self.client.search_logged_models([self.experiment], f"source_run_id = '{self.run}'")
        same = [each for each in found if self.marks.items() <= each.tags.items()]
        whole = [each for each in same if each.status == "READY"]
        for part in same:
            if part not in whole:
                self.client.delete_logged_model(part.model_id)
        return (f"models:/{whole[0].model_id}", whole[0].model_id) if whole else None

    def _log_model(self) -> tuple[str, str]:
        import mlflow

        from training.checkpoints.checkpoint import export_weights, require_checkpoint

        checkpoint = require_checkpoint(self.folder, "result")
        resolve_within(self.folder, os.path.relpath(checkpoint.path, self.folder))  # no other run's weights are sent
        packages = [_ROOT / "training", _ROOT / "datagen"]
        with tempfile.TemporaryDirectory() as temporary, _quiet_run(self.run):
            export_weights(checkpoint, Path(temporary) / "weights")
            with suppress(FileNotFoundError):  # what bodies it was trained on, for training.inference.domain_check
                about = read_within(self.folder, "provenance.json")
                (Path(temporary) / "weights" / "provenance.json").write_bytes(about)
            code = [str(shutil.copytree(p, Path(temporary) / p.name, ignore=_NO_CACHES)) for p in packages]
            model = mlflow.pyfunc.log_model(
                name="model",
                python_model=str(_ROOT / "training" / "inference" / "registered_model.py"),
                artifacts={"weights": str(Path(temporary) / "weights")},
                code_paths=code,
                signature=_signature(),
                pip_requirements=["torch", "safetensors", "numpy", "scipy", "pydantic", "filelock", "zarr", "trimesh"],
                tags=self.marks,
            )
        return model.model_uri, model.model_id

    def _register_version(self, name: str, source: str, model: str) -> str:
        """As log_model's own registration, which prints into the progress bars."""
        from mlflow.exceptions import MlflowException
        from mlflow.utils.mlflow_tags import MLFLOW_MODEL_VERSIONS

        try:
            call = _how_to_call(f"models:/{name}@{ALIAS}")
            self.client.create_registered_model(name, description=_DESCRIPTION.format(call=call))
        except MlflowException as error:
            if error.error_code != "RESOURCE_ALREADY_EXISTS":
                raise
        made = self.client.create_model_version(name, source, self.run, tags=self.marks, model_id=model)
        linked = json.dumps([{"name": name, "version": made.version}])  # by it the pages of runs link the version
        self.client.set_logged_model_tags(model, {MLFLOW_MODEL_VERSIONS: linked})
        return str(made.version)


@contextmanager
def _quiet_run(run: str) -> Iterator[None]:
    """The fluent API's run, without its advice on type hints and input examples (there is a signature)."""
    import mlflow

    with warnings.catch_warnings(), mlflow.start_run(run_id=run):
        warnings.simplefilter("ignore")
        yield


def _signature() -> Any:
    import numpy as np
    from mlflow.models import ModelSignature
    from mlflow.types import ParamSchema, ParamSpec, Schema, TensorSpec

    real, whole = np.dtype(np.float64), np.dtype(np.int64)
    names = {"source": real, "target": real, "target_faces": whole}
    inputs = Schema([TensorSpec(kind, (-1, 3), name) for name, kind in names.items()])
    options = {"up": ("string", "Y"), "front": ("string", ""), "align": ("boolean", False), "refine": ("double", 0.0)}
    params = ParamSchema([ParamSpec(name, *kind_and_default) for name, kind_and_default in options.items()])
    return ModelSignature(inputs=inputs, outputs=Schema([TensorSpec(real, (-1, 3), "vertices")]), params=params)


def _how_to_call(uri: str) -> str:
    """Markdown that says how a registered model, ``models:/NAME/VERSION`` or ``models:/NAME@ALIAS``, is called."""
    return _CALL.format(uri=uri)
