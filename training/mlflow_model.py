"""The registered model: what ``mlflow.pyfunc.load_model`` loads. MLflow runs this file as it is (models from code).

>>> model = mlflow.pyfunc.load_model("models:/dsffnet@latest-trained")              # doctest: +SKIP
>>> model.predict({"source": source_vertices, "target": vertices, "target_faces": faces})     # doctest: +SKIP
"""

import warnings
from typing import Any

import mlflow
import numpy as np
from mlflow.pyfunc import PythonModel

from datagen.mesh import Mesh
from training.transfer import PoseTransfer

# The model has a signature; MLflow's advice to type it otherwise does not fit a dictionary of arrays.
warnings.filterwarnings("ignore", message=".*Add type hints to the `predict` method")


class PoseTransferModel(PythonModel):  # type: ignore[misc]
    """Source vertices [n, 3], target vertices [m, 3] and target faces [f, 3] in; posed vertices [m, 3] out."""

    def load_context(self, context: Any) -> None:
        self._transfer = PoseTransfer.from_run(context.artifacts["weights"])

    def predict(self, context: Any, model_input, params=None):  # type: ignore[no-untyped-def]  # MLflow reads hints
        source, target = (np.asarray(model_input[name], np.float64) for name in ("source", "target"))
        faces = np.asarray(model_input["target_faces"], np.int64)
        return np.asarray(self._transfer.pose(source, Mesh(target, faces)).vertices)


mlflow.models.set_model(PoseTransferModel())
