"""The bodies of a dataset at rest, found once for all that is made of them."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import RecipeError
from datagen.mesh.rig import Rig, rest_vertices, world_rotations
from datagen.store import Dataset

_POSES = 8  # of an identity, that its body at rest is found from


class BodiesAtRest:
    """The bodies of some identities at rest, with their rigs.

    Attributes
    ----------
    dataset, identities
        Whose they are.
    rigs
        Of each identity.
    vertices
        Of each identity [vertex, 3] float64, metres, at the rest of its rig.

    Raises
    ------
    RecipeError
        An identity has no rig.
    DatasetError
        The dataset is damaged.
    """

    def __init__(self, dataset: Dataset, identities: Sequence[int]) -> None:
        require_rigs(dataset, identities)
        self.dataset, self.identities = dataset, [int(identity) for identity in identities]
        self.rigs = [_rig(dataset, identity) for identity in self.identities]
        self.vertices = [self._at_rest(*own) for own in zip(self.identities, self.rigs, strict=True)]

    @cached_property
    def world(self) -> NDArray[np.float64]:
        """World rotations [pose, joint, 3, 3] of the pose joints in all poses of the dataset, relative to rest."""
        return world_rotations(self.dataset.rotations(), self.dataset.attributes["joint_parents"])

    def _at_rest(self, identity: int, rig: Rig) -> NDArray[np.float64]:
        poses = self.dataset.grid.poses_of(identity)[:_POSES]
        posed = self.dataset.vertices(identity, poses).astype(np.float64)
        return rest_vertices(posed, rig.weights, rig.transforms(self.world[poses]))


def require_rigs(dataset: Dataset, identities: Sequence[int]) -> None:
    """Raise if one of these identities has no rig; none is read.

    Raises
    ------
    RecipeError
        One has none.
    """
    without = [int(identity) for identity in identities if dataset.rig_numbers[identity] < 0]
    if without:
        raise RecipeError(
            f"identity {without[0]} of {dataset.url} has no rig, which training.network 'parts' and "
            "training.augmentation.recombined need. Make a dataset of a body with a skeleton (anny, smpl, smal, "
            "rigged), or train another network with training.augmentation.recombined=0"
        )


def _rig(dataset: Dataset, identity: int) -> Rig:
    rig = dataset.rig(identity)
    assert rig is not None
    return rig
