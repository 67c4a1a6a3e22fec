"""Pose a mesh like another, and look at it.

    python examples/pose_a_mesh.py pose.obj person.glb posed.glb
    python examples/pose_a_mesh.py                                  # two people of Anny, made in the folder two-people

The weights that come along know people and animals, in any pose, size and direction. Some seconds a pair.
"""

import sys
from pathlib import Path

import numpy as np

from datagen.generate import generate
from datagen.mesh.files import load_mesh, save_mesh
from datagen.mesh.geometry import Mesh, edges_of
from dsffnet import DsffnetError, transfer
from workflows.recipe.loader import load_recipe

FOLDER = Path("two-people")
PEOPLE = ["data.identities.training=1", "data.identities.evaluation=1", "data.poses.seen=2", "data.poses.unseen=1"]


def two_people(folder: Path) -> tuple[Path, Path]:
    """Files of somebody in some pose, and of somebody else."""
    print("making two people (the first time, Anny's files are read: some ten seconds) ...", flush=True)
    recipe = load_recipe("quickstart", [*PEOPLE, "data.triples.count=0", "beside=null"]).data
    people = generate(recipe, str(folder / "two-people.zarr"))
    places = folder / "pose.obj", folder / "person.obj"
    for place, identity in zip(places, (0, 1), strict=True):
        save_mesh(Mesh(people.vertices(identity, identity), people.faces(identity)), place)
    return places


def stretched(before: Mesh, after: Mesh) -> float:
    """The mean change of an edge's length, as a share of it: how well the identity was kept."""
    ends = edges_of(before.faces)
    lengths = [np.linalg.norm(np.diff(mesh.vertices[ends], axis=1)[:, 0], axis=1) for mesh in (before, after)]
    return float(np.abs(lengths[1] / np.maximum(lengths[0], 1e-9) - 1).mean())


def main(words: list[str]) -> None:
    """Read, pose, write."""
    if words and len(words) != 3:
        raise SystemExit(__doc__)
    source, target, out = map(Path, words) if words else (*two_people(FOLDER), FOLDER / "posed.glb")
    print(f"posing {target} like {source} ...", flush=True)
    posed = transfer(source, target)  # also: trimesh objects, or pairs (vertices, faces)
    posed.export(out)
    change = stretched(load_mesh(target), Mesh(posed.vertices, posed.faces))
    print(f"{out}: {len(posed.vertices):,} vertices; edges differ from the target's by {100 * change:.1f} % on average")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except DsffnetError as error:
        raise SystemExit(f"error: {error}") from error
