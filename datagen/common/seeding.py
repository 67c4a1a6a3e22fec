"""Random numbers that are a pure function of (seed, stream, index), so that order and workers never matter."""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """Independent streams of one seed. The numbers are part of the dataset format: never renumber."""

    IDENTITY = 1
    POSE = 2
    EVALUATION_TRIPLES = 3
    TRAINING_TRIPLES = 4
    WEIGHTS = 5
    AUGMENTATION = 6


def generator(seed: int, stream: Stream, index: int = 0) -> np.random.Generator:
    """Return a counter-based generator whose draws depend on nothing but its three arguments."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence((seed, int(stream), index))))
