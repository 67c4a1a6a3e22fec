"""Joint trees that poses are written over: SMPL's 24 joints and SMAL's 35, each in its model's own order.

A joint's rotation is relative to its parent, in axes aligned with the rest pose (Y up, facing +Z, +X to the left).
"""

JOINTS: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
"""SMPL's 24 joints in SMPL's order."""

PARENTS: tuple[int, ...] = (
    -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21,
)  # fmt: skip
"""Parent of each of SMPL's joints (its kintree_table)."""

SMAL_JOINTS: tuple[str, ...] = (
    "root", "pelvis0", "spine", "spine0", "spine1", "spine2", "spine3",
    "LLeg1", "LLeg2", "LLeg3", "LFoot", "RLeg1", "RLeg2", "RLeg3", "RFoot", "Neck", "Head",
    "LLegBack1", "LLegBack2", "LLegBack3", "LFootBack", "RLegBack1", "RLegBack2", "RLegBack3", "RFootBack",
    "Tail1", "Tail2", "Tail3", "Tail4", "Tail5", "Tail6", "Tail7", "Mouth", "LEar", "REar",
)  # fmt: skip
"""SMAL's joints in SMAL's order; models with 33 joints lack the ears."""

SMAL_PARENTS: tuple[int, ...] = (
    -1, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 6, 11, 12, 13, 6, 15,
    0, 17, 18, 19, 0, 21, 22, 23, 0, 25, 26, 27, 28, 29, 30, 16, 16, 16,
)  # fmt: skip
"""Parent of each of SMAL's joints."""
