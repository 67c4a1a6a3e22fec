"""Making data: body models -> identity x pose grids of meshes -> Zarr shards. Knows nothing of training."""
