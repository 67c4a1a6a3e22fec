"""The registered model: what ``mlflow.pyfunc.load_model`` loads. MLflow runs this file as it is (models from code).

>>> model = mlflow.pyfunc.load_model("models:/dsffnet@latest-trained")              # doctest: +SKIP
>>> model.predict({"source": source_vertices, "target": vertices, "target_faces": faces})     # doctest: +SKIP
"""

from typing import Any

import mlflow
import numpy as np
from mlflow.pyfunc import PythonModel

from datagen.mesh import Mesh
from training.transfer import PoseTransfer


class PoseTransferModel(PythonModel):  # type: ignore[misc]
    """Source vertices [n, 3], target vertices [m, 3] and target faces [f, 3] in; posed vertices [m, 3] out."""

    _skip_type_hint_validation = True  # the signature validates; MLflow's type hints know no dictionary of arrays

    def load_context(self, context: Any) -> None:
        self._transfer = PoseTransfer.from_run(context.artifacts["weights"])

    def predict(self, context: Any, model_input, params=None):  # type: ignore[no-untyped-def]  # MLflow reads hints
        source, target = (np.asarray(model_input[name], np.float64) for name in ("source", "target"))
        faces = np.asarray(model_input["target_faces"], np.int64)
        return np.asarray(self._transfer.pose(source, Mesh(target, faces)).vertices)


mlflow.models.set_model(PoseTransferModel())
