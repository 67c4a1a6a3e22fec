"""What a dataset looks like on disk, without its values. Writes the golden file: python -m tests.support.layout"""

import json
import tempfile
from pathlib import Path
from typing import Any

_KEPT = ("shape", "data_type", "chunk_grid", "codecs", "fill_value", "dimension_names")


def layout(url: str) -> dict[str, Any]:
    """Attributes' names of the root, and for each array its metadata."""
    root = Path(url)
    found: dict[str, Any] = {"attributes": sorted(json.loads((root / "zarr.json").read_text())["attributes"])}
    for path in sorted(root.rglob("zarr.json")):
        name, metadata = str(path.parent.relative_to(root)), json.loads(path.read_text())
        if metadata["node_type"] == "array":
            found[name] = {key: metadata[key] for key in _KEPT}
    return found


if __name__ == "__main__":
    from datagen.generate import generate
    from tests.support.recipes import tiny_dataset

    golden = Path(__file__).parents[1] / "golden" / "dataset_layout.json"
    with tempfile.TemporaryDirectory() as folder:
        generate(tiny_dataset(), f"{folder}/leg.zarr")
        golden.write_text(json.dumps(layout(f"{folder}/leg.zarr"), indent=1) + "\n")
    print(golden)
