"""What is learned from the rigs of a dataset's bodies: parts and rotations, and bodies in other poses."""
