"""Other proportions for a rigged character: its parts longer or shorter, thicker or thinner, left and right alike.

Each bone stretches space along itself and around itself. Vertices first move by the weighted mean of their bones'
stretches; then every edge is eased towards the stretch that its own ends are under, because a mean of large
displacements, far from the bones, crumples what lies between two limbs.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from datagen.characters.character import Character
from datagen.characters.joint_names import parts
from datagen.mesh.geometry import edges_of

Scales = dict[str, tuple[float, float]]
"""Part of a body -> factors along its bones and across them."""

_EASINGS = 60  # rounds; enough for the some ten edges over which weights blend, too few to move a limb


@dataclass(frozen=True, eq=False)
class Stretchable:
    """A character, the part that each joint belongs to, and the directions in which its bones are long."""

    character: Character

    @cached_property
    def parts(self) -> list[str]:
        """The part of each joint."""
        return parts(self.character.names, self.character.parents)

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """Unit vectors [joint, 3] along which each bone is long; zero where a lone joint has no direction.

        A bone points at the next joints of its part, a last one on from the joint before. The torso is one block, long
        from hind limbs to forelimbs: in some rigs its first bone comes up from a control on the ground.
        """
        towards = np.zeros_like(self.character.joints)
        for joint, parent in enumerate(self.character.parents):
            if parent >= 0 and self.parts[parent] == self.parts[joint]:
                towards[parent] += self._bone(joint)
        for joint, parent in enumerate(self.character.parents):
            if parent >= 0 and not towards[joint].any():
                towards[joint] = self._bone(joint)
        towards[[part == "torso" for part in self.parts]] = self._torso_direction()
        length = np.linalg.norm(towards, axis=1, keepdims=True)
        return np.divide(towards, length, out=np.zeros_like(towards), where=length > 0)

    def stretched(self, scales: Scales) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Vertices [vertex, 3] and joints [joint, 3] of the character with its parts scaled, in metres."""
        along, across = np.array([scales[part] for part in self.parts]).T
        outer = self.directions[:, :, None] * self.directions[:, None, :]
        stretch = across[:, None, None] * np.eye(3) + (along - across)[:, None, None] * outer
        joints = self._joints(stretch)
        shift = joints - _turned(stretch, self.character.joints)
        blended = self.character.weights @ np.concatenate([stretch.reshape(-1, 9), shift], axis=1)
        matrices = blended[:, :9].reshape(-1, 3, 3)
        return self._eased(_turned(matrices, self.character.vertices) + blended[:, 9:], matrices), joints

    def _joints(self, stretch: NDArray[np.float64]) -> NDArray[np.float64]:
        joints = self.character.joints.copy()
        for joint, parent in enumerate(self.character.parents):
            if parent >= 0:
                joints[joint] = joints[parent] + (stretch[parent] * self._bone(joint)).sum(axis=1)
        return joints

    def _eased(self, vertices: NDArray[np.float64], stretch: NDArray[np.float64]) -> NDArray[np.float64]:
        """Damped Jacobi rounds that lessen the sum over edges of |v_i - v_j - (S_i + S_j) / 2 e|^2 / |e|^2.

        The division by the rest length makes it a matter of ratios: without it, short edges pay for long ones.
        """
        first, second = self._edges.T
        weighted = self._incidence.T @ scipy.sparse.diags_array(1 / (self._rest_edges**2).sum(axis=1))
        matrix = (weighted @ self._incidence).tocsr()
        wanted = weighted @ _turned((stretch[first] + stretch[second]) / 2, self._rest_edges)
        step = 0.5 / matrix.diagonal()[:, None]
        for _ in range(_EASINGS):
            vertices = vertices + step * (wanted - matrix @ vertices)
        return vertices

    @cached_property
    def _edges(self) -> NDArray[np.int64]:
        return edges_of(self.character.faces)

    @cached_property
    def _rest_edges(self) -> NDArray[np.float64]:
        return self.character.vertices[self._edges[:, 0]] - self.character.vertices[self._edges[:, 1]]

    @cached_property
    def _incidence(self) -> scipy.sparse.csr_array:
        """[edge, vertex]: +1 at an edge's first end, -1 at its second."""
        count = len(self._edges)
        signs = np.repeat([1.0, -1.0], count)
        places = np.tile(np.arange(count), 2), self._edges.T.ravel()
        return scipy.sparse.csr_array((signs, places), shape=(count, len(self.character.vertices)))

    def _bone(self, joint: int) -> NDArray[np.float64]:
        return self.character.joints[joint] - self.character.joints[self.character.parents[joint]]

    def _torso_direction(self) -> NDArray[np.float64]:
        hind, fore = self._middle_of_roots("hindlimbs"), self._middle_of_roots("forelimbs")
        if hind is None or fore is None:
            return np.array([0.0, 0.0, 1.0])
        return fore - hind

    def _middle_of_roots(self, limbs: str) -> NDArray[np.float64] | None:
        found = [
            joint
            for joint, parent in enumerate(self.character.parents)
            if self.parts[joint] == limbs and (parent < 0 or self.parts[parent] != limbs)
        ]
        return self.character.joints[found].mean(axis=0) if found else None


def _turned(matrices: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each vector [n, 3] by its matrix [n, 3, 3], with sums in one order whatever the machine."""
    return (matrices * vectors[:, None, :]).sum(axis=2)
