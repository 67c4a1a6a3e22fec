"""SMPL, SMPL-H, SMPL-X and SMAL, from their owners' files."""
