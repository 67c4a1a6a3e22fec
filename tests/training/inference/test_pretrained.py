"""The weights that come with the project load, fit their manifest, and pose a body that they were not trained on."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from benchmarks.transfer.everyday import Person
from datagen.bodies import load_body
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh, bounding_box
from datagen.poses import draw_poses
from datagen.recipe import AnnyBody, AnnyTopology, PoseRecipe
from training.inference.mesh_reading import surfaces_of
from training.inference.standing import MISREAD, Standing
from training.inference.transfer import PoseTransfer
from training.networks.layers.sampling import sample
from training.objectives.metrics import point_mesh_distance
from workflows.pretrained import weights_named


@dataclass(frozen=True)
class Case:
    """Sources [pose, n, 3] of one person, the same poses [pose, m, 3] of another, and the target: its first."""

    sources: np.ndarray
    truths: np.ndarray
    target: Mesh


def people(topology: AnnyTopology = "notoes_collapse5pc", *, poses: int = 8) -> Case:
    body = load_body(AnnyBody(topology=topology))
    source, target = (body.draw_identity(generator(7, Stream.IDENTITY, number), number) for number in (0, 1))
    drawn = draw_poses(PoseRecipe(seed=7), range(poses))
    sources, truths = (body.vertices(who, drawn) for who in (source, target))
    return Case(sources, truths, Mesh(truths[0], body.faces(target)))


@pytest.fixture(scope="module")
def human() -> PoseTransfer:
    return PoseTransfer.from_run(weights_named("human"), device="cpu")


def pmd(outputs: np.ndarray, truths: np.ndarray) -> float:
    pair = (torch.from_numpy(_boxed(meshes)) for meshes in (outputs, truths))
    return float(point_mesh_distance(*pair).mean())


@pytest.mark.parametrize(("weights", "most"), [("dsffnet-people", 0.005), ("human", 0.0001), ("dressed", 0.0002)])
def test_new_people_are_brought_into_new_poses(weights: str, most: float) -> None:
    transfer, case = PoseTransfer.from_run(weights_named(weights), device="cpu"), people()
    sources = [Mesh(vertices, case.target.faces) for vertices in case.sources[1:]]
    outputs = np.stack([transfer.unplaced(source, case.target) for source in sources])
    unchanged = np.broadcast_to(case.truths[:1], outputs.shape)
    error, doing_nothing = (pmd(found, case.truths[1:]) for found in (outputs, unchanged))
    assert error < most and 8 * error < doing_nothing


@pytest.mark.parametrize("pose", ["sitting", "arms crossed", "reading", "hands on hips", "waving", "telephone"])
def test_everyday_poses_are_taken(human: PoseTransfer, pose: str) -> None:
    """Of which NPT's joint ranges have none."""
    source, target = Person(0.5, "notoes_collapse5pc", 1), Person(0.8, "notoes_collapse5pc", 2)
    posed = human.unplaced(source(pose), target("standing"))
    assert pmd(posed[None], target(pose).vertices[None]) < 0.0008


@pytest.mark.parametrize("pose", ["hands on hips", "cross-legged", "on one leg", "hands up", "hugging the knees"])
@pytest.mark.parametrize("way", [("y", 0), ("y", 180), ("x", -90)])
def test_people_who_fold_their_limbs_are_found_to_stand_as_they_do(
    human: PoseTransfer, pose: str, way: tuple[str, float]
) -> None:
    """Whom vertices alone misunderstand, so that their surface decides, or who look much the same from behind."""
    mesh, turn = Person(0.55, "notoes_collapse10pc", 3)(pose), Rotation.from_euler(*way, degrees=True)
    found = human.standing(Mesh(turn.apply(mesh.vertices), mesh.faces))
    assert isinstance(found, Standing)
    left = Rotation.from_matrix(found.lean.T @ found.matrix) * turn
    assert np.degrees(left.magnitude()) < (20 if pose == "hugging the knees" else 15)


def test_what_is_read_of_a_body_that_is_not_dense_is_most_of_it() -> None:
    drawn = sample(torch.from_numpy(_boxed(people(poses=2).sources)).float())
    assert drawn.masses.shape == (2, 615)
    assert ((drawn.masses > 0).sum(1) > 500).all()


def test_a_source_may_be_turned_or_lie_and_the_target_answers_in_its_own_axes(human: PoseTransfer) -> None:
    case, lying = people(poses=3), Rotation.from_euler("x", -90, degrees=True)
    ways = (Rotation.identity(), Rotation.from_euler("y", 100, degrees=True), lying)
    posed = [
        human(source=Mesh(case.sources[2] @ way.as_matrix().T, case.target.faces), target=case.target) for way in ways
    ]
    for mesh in posed:
        assert pmd(mesh.vertices[None], case.truths[2:]) < 0.0025
    turned = Mesh(case.target.vertices @ lying.as_matrix().T, case.target.faces)
    answer = human(source=Mesh(case.sources[2], case.target.faces), target=turned).vertices @ lying.as_matrix()
    assert pmd(answer[None], case.truths[2:]) < 0.0025


def test_a_source_that_leans_gives_its_lean_and_a_target_that_leans_does_not_matter(human: PoseTransfer) -> None:
    case = people(poses=3)
    faces = case.target.faces
    for axis, degrees in (("x", 30), ("z", 30), ("x", 45), ("z", -45)):
        lean = Rotation.from_euler(axis, degrees, degrees=True)
        posed = human(source=Mesh(lean.apply(case.sources[2]), faces), target=case.target)
        assert pmd(posed.vertices[None], lean.apply(case.truths[2])[None]) < 0.0006
        posed = human(source=Mesh(case.sources[2], faces), target=Mesh(lean.apply(case.target.vertices), faces))
        assert pmd(posed.vertices[None], case.truths[2:]) < 0.0006


def test_a_hand_that_lies_on_a_leg_is_not_taken_for_it(human: PoseTransfer) -> None:
    """Two people of the quickstart's dataset; untold, the leg is drawn out to the hand."""
    body = load_body(AnnyBody(topology="notoes_collapse5pc", phenotypes={"age": (0.0, 1.0)}))
    source, target = (body.draw_identity(generator(0, Stream.IDENTITY, number), number) for number in (20, 23))
    standing, touching = 1508, 1418
    poses = draw_poses(PoseRecipe(), [standing, touching])
    truth, given = body.vertices(target, poses)
    wanted, faces = Mesh(body.vertices(source, poses)[0], body.faces(source)), body.faces(target)
    error = pmd(human.unplaced(wanted, Mesh(given, faces))[None], truth[None])
    untold = pmd(human.vertices(wanted.vertices, given)[None], truth[None])
    assert error < 0.0006 and untold > 5 * error


def test_a_person_who_turns_round_stays_posed(human: PoseTransfer) -> None:
    case, ways = people(poses=3), [Rotation.from_euler("y", angle, degrees=True) for angle in range(0, 200, 25)]
    frames = [Mesh(way.apply(case.sources[2]), case.target.faces) for way in ways]
    for way, posed in zip(ways, human.sequence(frames, case.target), strict=True):
        assert pmd(way.inv().apply(posed.vertices)[None], case.truths[2:]) < 0.0025


def test_another_sampling_of_the_source_changes_little(human: PoseTransfer) -> None:
    coarse, fine = people(poses=5), people("notoes", poses=5)
    assert fine.sources.shape[1] > 10 * coarse.sources.shape[1]
    one, other = (
        pmd(np.stack([human.vertices(mesh, coarse.truths[0]) for mesh in its.sources[1:]]), coarse.truths[1:])
        for its in (coarse, fine)
    )
    assert other < 1.5 * one + 0.0001


def test_noise_of_a_source_is_mostly_filtered(human: PoseTransfer) -> None:
    case = people(poses=7)
    faces, random = case.target.faces, np.random.default_rng(0)
    rough = [Mesh(each + random.normal(0, 0.017, each.shape), faces) for each in case.sources[1:]]
    error = pmd(np.stack([human.unplaced(mesh, case.target) for mesh in rough]), case.truths[1:])
    known = [surfaces_of(human._network, sources=[mesh], targets=[case.target]) for mesh in rough]
    read = [
        human.vertices(mesh.vertices, case.target.vertices, **told) for mesh, told in zip(rough, known, strict=True)
    ]
    unfiltered = pmd(np.stack(read), case.truths[1:])
    assert error < 0.9 * unfiltered and error < 0.0003


def test_what_is_no_person_is_said_to_be_strange(human: PoseTransfer) -> None:
    box = Mesh(np.random.default_rng(0).uniform(-1, 1, (400, 3)), np.array([[0, 1, 2]]))
    found = human.standing(box)
    assert human.rest_error(Mesh(found.upright(box.vertices), box.faces)) > 1.5 * MISREAD
    target = people(poses=1).target
    known = human.standing(target)
    assert isinstance(known, Standing) and np.array_equal(known.matrix, np.eye(3))
    assert human.rest_error(target) < 0.75 * MISREAD


def _boxed(meshes: np.ndarray) -> np.ndarray:
    return np.stack([bounding_box(mesh).normalise(mesh).astype(np.float64) for mesh in meshes])
