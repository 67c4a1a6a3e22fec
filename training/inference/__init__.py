"""Using a trained network: prediction, transfer of mesh files, the registered model."""
