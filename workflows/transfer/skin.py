"""``dsffnet skin``: a skeleton and smooth skinning weights for a mesh that lies around a body."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.bodies import FAMILIES, load_body
from datagen.common.errors import MeshError, RecipeError
from datagen.common.files import write_atomically
from datagen.generate.identities import identity_parameters
from datagen.mesh.files import MeshFile, check_writable, read_mesh_file, save_mesh
from datagen.mesh.formats.gltf import SUFFIXES
from datagen.mesh.geometry import Mesh
from datagen.mesh.rig import rest_vertices
from datagen.mesh.skinned_glb import Skeleton, four_influences, skinned_glb
from datagen.poses import Poses
from training.avatar.body import CanonicalBody, canonical_body
from training.avatar.diffusion import thin_plate
from training.avatar.solid import Solid
from workflows.pipeline.console import warn
from workflows.recipe.loader import WorkflowRecipe, change_recipe, load_recipe

_OFFSET = 0.006  # of the body's largest extent: a centimetre of a person
_FAR = 0.25  # of it: a mesh the half of which is further from the skin does not lie around the body
_APART, _TENTH = 0.1, 0.9  # of it: a mesh a tenth of which is further from the skin may stand otherwise than the body


@dataclass(frozen=True)
class SkinJob:
    """What is asked for: a mesh to skin and where to, around which identity of which body, and where that goes.

    ``body`` is a family, a rigged model's file, or a recipe; ``overrides`` change its recipe.
    """

    body: str
    overrides: list[str]
    identity: int = 0
    mesh: Path | None = None
    out: Path | None = None
    body_mesh: Path | None = None

    def check(self) -> None:
        """Refuse what cannot be written, before any work.

        Raises
        ------
        RecipeError, MeshError, StorageError
            Options that do not fit together; places that cannot be written.
        """
        if (self.mesh is None) != (self.out is None) or (self.mesh is None and self.body_mesh is None):
            raise RecipeError(
                "name a mesh and --out RIGGED.glb, or --body-mesh FILE for the body alone, or all of them"
            )
        if self.identity < 0:
            raise RecipeError(f"--identity {self.identity}: identities are counted from 0")
        if self.out is not None and self.out.suffix.lower() != ".glb":
            raise MeshError(f"--out {self.out}: a mesh with a skeleton is written as .glb only")
        for place in filter(None, (self.out, self.body_mesh)):
            check_writable(place)
            if self.mesh is not None and place.resolve() == self.mesh.resolve():
                raise MeshError(f"{place} is the mesh that is read: choose another place to write to")

    def run(self) -> list[str]:
        """Skin the mesh; the lines to print.

        Raises
        ------
        BodyError, MeshError
            A body without a skeleton, a mesh that cannot be read or does not lie around the body.
        """
        mesh = None if self.mesh is None else read_mesh_file(self.mesh)
        body, said = self.resting_body(), list[str]()
        if self.body_mesh is not None:
            save_mesh(Mesh(body.vertices.astype(np.float32), body.faces), self.body_mesh)
            said.append(f"{self.body_mesh}: the body at rest, {len(body.vertices):,} vertices")
        if mesh is not None and self.out is not None:
            said += _skinned(mesh, body, self.out)
        return said

    def resting_body(self) -> CanonicalBody:
        """The body in the rest pose of its pose joints, for people the T-pose, and its bones."""
        recipe = self._recipe().data
        model = load_body(recipe.body)
        parameters, joints = identity_parameters(recipe, model, self.identity), model.joints
        rig = model.rig(parameters, joints)
        if rig is None:
            raise MeshError(
                f"--body {self.body}: the family {recipe.body.family!r} has no skeleton. Choose another body"
            )
        alone = (-1,) * len(joints)
        poses = Poses(joints, alone, np.zeros((1, len(joints), 3)))
        own = rest_vertices(model.vertices(parameters, poses), rig.weights, rig.transforms(poses.world()))
        return canonical_body(rig, own, model.faces(parameters), joints, alone, spread=0.0)

    def _recipe(self) -> WorkflowRecipe:
        if Path(self.body).suffix.lower() in SUFFIXES:
            section: dict[str, Any] = {"family": "rigged", "path": str(Path(self.body).absolute()), "bone_scale": 0}
        elif self.body in FAMILIES:
            section = {"family": self.body}
        else:
            return load_recipe(self.body, self.overrides)
        return change_recipe({"data": {"body": section}}, self.overrides, where=self.body)


def _skinned(mesh: MeshFile, body: CanonicalBody, out: Path) -> list[str]:
    vertices = mesh.mesh.vertices.astype(np.float64)
    _require_around(mesh, body)
    weights = thin_plate(body, offset=_OFFSET * _extent(body)).weights(vertices)
    content, left_out = skinned_glb(mesh, Skeleton(body.names, body.parents, body.joints), weights)
    write_atomically(out, content)
    kept = 1 - np.abs(four_influences(weights) - weights).sum(axis=1) / 2
    leading = int((weights.max(axis=0) > 0.5).sum())
    return [
        f"{out}: {len(vertices):,} vertices on {len(body.names)} bones, {leading} of which lead some of them",
        f"four bones a vertex keep {kept.mean():.1%} of the weights (worst vertex {kept.min():.1%})",
        *(f"left out: {line}" for line in left_out),
    ]


def _require_around(mesh: MeshFile, body: CanonicalBody) -> None:
    """Refuse a mesh that does not lie around the body, and warn of one that may stand otherwise."""
    away = np.abs(Solid(body.vertices, body.faces).depth(mesh.mesh.vertices))
    near, far = np.quantile(away, (0.5, _TENTH))
    if near > _FAR * _extent(body):
        raise MeshError(
            f"{mesh.path} does not lie around the body at rest: it spans {_spans(mesh.mesh.vertices)}, the body "
            f"{_spans(body.vertices)} (metres, Y up, facing +Z). Bring it there; --body-mesh FILE writes the body"
        )
    if far > _APART * _extent(body):
        warn(
            f"a tenth of {mesh.path} is {100 * far:.0f} cm or more from the body at rest, half within "
            f"{100 * near:.0f} cm: if it stands in another pose, it will move wrongly. Bring it to rest, people to the "
            "T-pose; --body-mesh FILE writes the body"
        )


def _extent(body: CanonicalBody) -> float:
    return float(np.ptp(body.vertices, axis=0).max())


def _spans(vertices: NDArray[np.floating]) -> str:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return ", ".join(f"{axis} {start:.3g} to {end:.3g}" for axis, start, end in zip("xyz", low, high, strict=True))
