"""Pose transfer from Python, as ``dsffnet transfer`` does it: the same weights, checks and bits.

>>> from dsffnet import transfer
>>> posed = transfer("pose.obj", "person.glb")  # doctest: +SKIP
>>> posed.export("posed.glb")  # doctest: +SKIP
"""

import os
import warnings
from typing import TYPE_CHECKING, Any

from datagen.common.errors import DsffnetError, DsffnetWarning

if TYPE_CHECKING:
    from dsffnet.posed import PosedMesh

__all__ = ["DsffnetError", "DsffnetWarning", "transfer"]


def transfer(
    source: Any,
    target: Any,
    *,
    model: str | os.PathLike[str] | None = None,
    refine: bool = False,
    align: bool = False,
    up: str | None = None,
    front: str | None = None,
    force: bool = False,
) -> "PosedMesh":
    """Return the target in the pose of the source; what is doubtful is a `DsffnetWarning`.

    Parameters
    ----------
    source, target
        The mesh in the wanted pose and the mesh of the wanted identity, each a path (OBJ, PLY, GLB, OFF, STL), an
        object with ``vertices`` and ``faces`` such as a ``trimesh.Trimesh``, a ``trimesh.Scene`` whose geometries make
        one body, or a pair (vertices [n, 3], triangles [f, 3]). The source may be points: an OBJ or a PLY without
        faces, a ``trimesh.PointCloud``, an array [n, 3]. They may differ in vertices, faces, size and place, and are
        not changed.
    model
        A run folder, weights, ``models:/NAME@ALIAS`` (of the server MLFLOW_TRACKING_URI), or the name of weights that
        come along; by default `human`, `dressed` or `animals`, by the meshes.
    refine
        Pull the edges back to the target's.
    align
        Find by the network how each mesh stands; the weights that come along always do.
    up, front
        Say how they stand: an axis (``"Z"``, ``"-Y"``), or two, ``"SOURCE,TARGET"``.
    force
        Without ``model``: pose even a person like an animal.

    Returns
    -------
    PosedMesh
        ``vertices`` [n, 3] float64 in the target's order, unit and axes, ``faces`` [f, 3]; ``export(path)`` writes it.

    Raises
    ------
    DsffnetError
        One line for whatever is wrong with a mesh, an option or the weights.

    Examples
    --------
    >>> import trimesh
    >>> body = trimesh.load("person.glb", force="mesh", process=False)  # doctest: +SKIP
    >>> transfer("pose.obj", body, model="human").vertices  # doctest: +SKIP
    """
    from dsffnet.posed import Options, posed

    found = posed(source, target, Options(model, refine, align, up, front, force))
    for doubt in found.doubts:
        warnings.warn(doubt, DsffnetWarning, stacklevel=2)
    return found
