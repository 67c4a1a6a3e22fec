"""Anny's rigs in SMPL's terms: which bones carry which SMPL joint, and how the resting arms get to the T-pose.

A pose gives world rotations of SMPL's joints. A bone that carries a joint takes its rotation; any other (twist bones,
metacarpals, eyes, thumbs, toes beyond the first) follows its parent. Among several bones along one stretch of spine or
neck the one nearest to the place of Mixamo's carries the joint, so that all rigs bend in the same places.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.recipe import AnnyRig

_CENTRE = {
    "mixamo": "pelvis Hips, spine1 Spine, spine2 Spine1, spine3 Spine2, neck Neck, head Head",
    "cmu_mb": "pelvis Hips, spine1 LowerBack, spine2 Spine, spine3 Spine1, neck Neck, head Neck1",
    "anny": "pelvis root, spine1 spine03, spine2 spine02, spine3 spine01, neck neck01, head neck03",
    "soma": "pelvis Hips, spine1 Spine1, spine2 Spine2, spine3 Chest, neck Neck1, head Neck2",
}
_SIDED = {
    "mixamo": "hip *UpLeg, knee *Leg, ankle *Foot, foot *ToeBase, collar *Shoulder, shoulder *Arm, elbow *ForeArm, "
    "wrist *Hand, hand *HandIndex1 *HandMiddle1 *HandRing1 *HandPinky1",
    "cmu_mb": "hip *UpLeg, knee *Leg, ankle *Foot, foot *ToeBase, collar *Shoulder, shoulder *Arm, elbow *ForeArm, "
    "wrist *Hand, hand *HandFinger1",
    "anny": "hip upperleg01.*, knee lowerleg01.*, ankle foot.*, "
    "foot toe1-1.* toe2-1.* toe3-1.* toe4-1.* toe5-1.*, collar clavicle.*, shoulder upperarm01.*, elbow lowerarm01.*, "
    "wrist wrist.*, hand finger2-1.* finger3-1.* finger4-1.* finger5-1.*",
    "soma": "hip *Leg, knee *Shin, ankle *Foot, foot *ToeBase, collar *Shoulder, shoulder *Arm, elbow *ForeArm, "
    "wrist *Hand, hand *HandIndex2 *HandMiddle2 *HandRing2 *HandPinky2",
}


def carriers(rig: AnnyRig) -> dict[str, str]:
    """The bones of a rig that carry an SMPL joint, with the joint's name."""
    sides = {"left": "L", "right": "R"} if rig == "anny" else {"left": "Left", "right": "Right"}
    found = {bone: joint for joint, bones in _entries(_CENTRE[rig]) for bone in bones}
    for side, mark in sides.items():
        found |= {bone.replace("*", mark): f"{side}_{part}" for part, bones in _entries(_SIDED[rig]) for bone in bones}
    return found


def _entries(text: str) -> list[tuple[str, list[str]]]:
    return [(words[0], words[1:]) for words in map(str.split, text.split(","))]


@dataclass(frozen=True)
class Bones:
    """A rig's bones, parents before children.

    ``order`` [bone] are their numbers in Anny, ``labels`` their names there, ``joints`` the SMPL joints they carry.
    """

    order: NDArray[np.int64]
    labels: tuple[str, ...]
    joints: tuple[str | None, ...]
    parents: tuple[int, ...]

    @classmethod
    def of(cls, rig: AnnyRig, labels: Sequence[str], parents: Sequence[int]) -> "Bones":
        """The bones of a rig that Anny calls ``labels``, in any order."""
        order = parents_first(parents)
        place = np.argsort(order)
        names = tuple(labels[bone].split(":")[-1] for bone in order)
        carried = carriers(rig)
        return cls(
            order=order,
            labels=names,
            joints=tuple(carried.get(name) for name in names),
            parents=tuple(int(place[parents[bone]]) if parents[bone] >= 0 else -1 for bone in order),
        )


def parents_first(parents: Sequence[int]) -> NDArray[np.int64]:
    """Numbers of the bones [bone], every parent before its children, otherwise in the order in which they came."""
    order: list[int] = []
    waiting = list(range(len(parents)))
    while waiting:
        placed = {-1, *order}
        ready = next(bone for bone in waiting if parents[bone] in placed)
        order.append(ready)
        waiting.remove(ready)
    return np.array(order, np.int64)


def t_pose_corrections(bones: Bones, heads: NDArray[np.float64]) -> NDArray[np.float64]:
    """World rotations [bone, 3, 3] that take the arms from rest positions ``heads`` [bone, 3] to SMPL's T-pose.

    Upper arm, then forearm, are each turned the shortest way until they point straight to their side; what hangs on
    them goes along. The identity elsewhere. Frame: Y up, facing +Z.
    """
    corrections = np.tile(np.eye(3), (len(bones.joints), 1, 1))
    for side, outward in (("left", 1.0), ("right", -1.0)):
        for joint, end in (("shoulder", "elbow"), ("elbow", "wrist")):
            bone, tip = bones.joints.index(f"{side}_{joint}"), bones.joints.index(f"{side}_{end}")
            inherited = corrections[bones.parents[bone]]
            direction = inherited @ (heads[tip] - heads[bone])
            turn = Rotation.align_vectors([[outward, 0.0, 0.0]], [direction])[0].as_matrix()
            corrections[_subtree(bones.parents, bone)] = turn @ inherited
    return corrections


def _subtree(parents: Sequence[int], root: int) -> list[int]:
    below = {root}
    for bone, parent in enumerate(parents):
        if parent in below:
            below.add(bone)
    return sorted(below)
