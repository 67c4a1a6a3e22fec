"""A leg in a stocking as an outfit: body, scans and what is drawn of them, without assets, in a second."""

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from datagen.bodies import load_body
from datagen.mesh.geometry import Mesh, vertex_normals
from datagen.mesh.rig import rest_vertices
from datagen.poses import JOINTS
from datagen.recipe import LegBody
from tests.support.shapes.canonical import posed_leg
from training.avatar.diffusion import diffused_skinning
from training.avatar.occupancy import FrameSamples, frame_samples, surface_points
from training.avatar.outfit import OccupancySamples, Outfit, SurfaceSamples
from training.avatar.subject import Subject
from training.avatar.template import Template, pose_condition

_OFF = 0.01  # metres between leg and stocking


def stockinged() -> Subject:
    """The leg in four poses, the last unseen: its surface is a stocking a centimetre off."""
    leg = posed_leg()
    scans = np.stack([posed + _OFF * vertex_normals(posed, leg.body.faces) for posed in leg.posed])
    return Subject(
        name="stocking",
        source="a leg",
        body=leg.body,
        scans=scans.astype(np.float32),
        faces=leg.body.faces,
        parts=np.ones(scans.shape[1], np.int64),
        transforms=leg.transforms.astype(np.float32),
        rotations=leg.poses.rotations.astype(np.float32),
        is_seen=np.array([True, True, True, False]),
    )


def person_arrays() -> dict[str, np.ndarray]:
    """The arrays of a file of scans: the stockinged leg over SMPL's joints, as a person walks about."""
    model, parameters, leg = load_body(LegBody(rings=32, segments=12)), np.array([0.9, 0.1, 0.05, 0.5]), posed_leg()
    rig, subject = model.rig(parameters, JOINTS), stockinged()
    assert rig is not None
    weights, places = np.zeros((len(rig.weights), len(JOINTS))), np.zeros((len(JOINTS), 3))
    for part, driver in enumerate(rig.drivers):
        weights[:, driver] += rig.weights[:, part]
        places[driver] = rig.joints[part]
    random = np.random.default_rng(0)
    poses = leg.poses.rotations.copy()
    poses[:, 0] = random.normal(0, 1, (len(poses), 3))
    moves = random.normal(0, 1, (len(poses), 3))
    turned = Rotation.from_rotvec(poses[:, 0]).as_matrix()
    scans = (subject.scans - places[0]) @ turned.transpose(0, 2, 1) + places[0] + moves[:, None]
    return {
        "scans": scans,
        "faces": subject.faces,
        "poses": poses,
        "joints": np.array(JOINTS),
        "translations": moves,
        "body_vertices": rest_vertices(leg.posed, rig.weights, rig.transforms(leg.poses.world())),
        "body_faces": leg.body.faces,
        "body_weights": weights,
        "body_joints": places,
    }


def drawn_outfit(folder: Path, *, with_template: bool = True) -> Outfit:
    """Its folder; the template is the bare leg."""
    subject, outfit = stockinged(), Outfit(folder / "stocking")
    subject.save(outfit.subject.path)
    field = diffused_skinning(subject.body, centres=80, spacing=0.08)
    field.save(outfit.field.path)
    around, surfaces = list[FrameSamples](), list[tuple[torch.Tensor, torch.Tensor]]()
    for frame in range(len(subject.scans)):
        random, scan = np.random.default_rng(frame), [subject.scan(frame)]
        transforms = subject.transforms[frame].astype(np.float64)
        given = {"body": subject.body, "field": field, "transforms": transforms}
        around.append(frame_samples(random, scan, count=400, **given))
        points, normals = surface_points(random, scan, 800)
        surfaces.append((torch.from_numpy(points).float(), torch.from_numpy(normals).float()))
    SurfaceSamples(*(torch.stack(its) for its in zip(*surfaces, strict=True))).save(outfit.surfaces.path)
    OccupancySamples(
        *(torch.stack(its) for its in zip(*around, strict=True)),
        conditions=pose_condition(subject.rotations.astype(np.float64)),
        is_seen=torch.from_numpy(subject.is_seen),
        hand_points=torch.empty(0, 3),
        hand_inside=torch.empty(0, dtype=torch.bool),
    ).save(outfit.samples.path)
    if with_template:
        bare_template(Mesh(subject.body.vertices, subject.body.faces), subject.body.weights).save(outfit.template.path)
    return outfit


def bare_template(mesh: Mesh, weights: np.ndarray) -> Template:
    """A mesh as a template."""
    normals = vertex_normals(mesh.vertices, mesh.faces)
    arrays = mesh.vertices, mesh.faces, normals, weights
    vertices, faces, normals, weights = (torch.from_numpy(np.ascontiguousarray(its)) for its in arrays)
    return Template(vertices.float(), faces, normals.float(), weights.float())
