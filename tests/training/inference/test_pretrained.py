"""The weights that come with the project load, fit their manifest, and pose a body that they were not trained on."""

from pathlib import Path

import numpy as np
import torch

from datagen.bodies import load_body
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import bounding_box
from datagen.poses import draw_poses
from datagen.recipe import AnnyBody, PoseRecipe
from training.inference.transfer import PoseTransfer
from training.objectives.metrics import point_mesh_distance

PRETRAINED = Path(__file__).parents[3] / "pretrained"


def test_the_quickstarts_weights_bring_new_people_into_new_poses() -> None:
    transfer = PoseTransfer.from_run(PRETRAINED / "anny-quickstart", device="cpu")
    body = load_body(AnnyBody(topology="notoes_collapse5pc"))
    source, target = (body.draw_identity(generator(7, Stream.IDENTITY, number), number) for number in (0, 1))
    poses = draw_poses(PoseRecipe(seed=7), range(8))
    sources, truths = (body.vertices(who, poses) for who in (source, target))
    outputs = np.stack([transfer.vertices(vertices, truths[0]) for vertices in sources[1:]])
    unchanged = np.broadcast_to(_boxed(truths[:1]), outputs.shape)
    error, doing_nothing = (
        float(point_mesh_distance(torch.from_numpy(np.array(found)), torch.from_numpy(_boxed(truths[1:]))).mean())
        for found in (outputs, unchanged)
    )
    assert error < 0.005 and 8 * error < doing_nothing


def _boxed(meshes: np.ndarray) -> np.ndarray:
    return np.stack([bounding_box(mesh).normalise(mesh).astype(np.float64) for mesh in meshes])
