"""The dataset format (Zarr v3): schema (the contract), writer, reader, verify. See docs/dataset-format.md."""

from datagen.store.manifest import ManifestRow
from datagen.store.reader import Dataset, open_dataset
from datagen.store.schema import FORMAT_VERSION

__all__ = ["FORMAT_VERSION", "Dataset", "ManifestRow", "open_dataset"]
