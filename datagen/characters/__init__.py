"""Rigged glTF characters: skin, joints, animation."""
