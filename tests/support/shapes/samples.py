"""What the parts network's sample says of all vertices of meshes."""

import torch

from training.networks.layers.sampling import Sample, others, taken


def offsets_of(vertices: torch.Tensor, drawn: Sample) -> torch.Tensor:
    """How far [b, n, 3] all vertices lie from the middle of what is near (`Surroundings.offsets`), in their order."""
    every = [(drawn.rows, drawn.around), *others(vertices, drawn)]
    rows, offsets = (torch.cat(its, dim=1) for its in zip(*((some, at.offsets) for some, at in every), strict=True))
    assert torch.equal(rows.sort(dim=1).values, torch.arange(vertices.shape[1]).expand_as(rows)), "each vertex once"
    return taken(offsets, rows.argsort(dim=1))
