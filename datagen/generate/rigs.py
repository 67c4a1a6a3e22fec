"""The rigs of a dataset's identities, gathered: those whose bodies have the same parts are stored together."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.mesh.rig import Rig, Rigs


class RigCollection:
    """The rigs of identities, which are added one after another, numbered as they appear."""

    def __init__(self) -> None:
        self._kindred: dict[tuple[object, ...], _Kindred] = {}

    def add(self, rig: Rig | None) -> int:
        """The number of the next identity's rig, -1 where its body has none."""
        if rig is None:
            return -1
        key = rig.names, rig.parents, rig.drivers, rig.corrections.tobytes(), rig.weights.shape
        kindred = self._kindred.setdefault(key, _Kindred(rig, len(self._kindred)))
        kindred.add(rig)
        return kindred.number

    @property
    def rigs(self) -> list[Rigs]:
        """The rigs by number."""
        return [kindred.rigs() for kindred in self._kindred.values()]

    @property
    def parts(self) -> list[dict[str, Any]]:
        """Names, parents and drivers of the parts of each, for the attributes."""
        firsts = [kindred.first for kindred in self._kindred.values()]
        return [{key: list(getattr(rig, key)) for key in ("names", "parents", "drivers")} for rig in firsts]


class _Kindred:
    """Rigs of the same parts; weights that are the same are kept once."""

    def __init__(self, first: Rig, number: int) -> None:
        self.first, self.number = first, number
        self._weights: dict[bytes, int] = {}
        self._kinds: list[int] = []
        self._joints: list[NDArray[np.float32]] = []

    def add(self, rig: Rig) -> None:
        self._kinds.append(self._weights.setdefault(rig.weights.tobytes(), len(self._weights)))
        self._joints.append(rig.joints)

    def rigs(self) -> Rigs:
        weights = [np.frombuffer(content, np.float32).reshape(self.first.weights.shape) for content in self._weights]
        return Rigs(
            names=self.first.names,
            parents=self.first.parents,
            drivers=self.first.drivers,
            corrections=self.first.corrections,
            weights=np.stack(weights),
            kinds=np.array(self._kinds, np.int32),
            joints=np.stack(self._joints),
        )
