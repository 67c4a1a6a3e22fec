"""Dressed people: garments fit identities of all ages; a draped pose has the same bytes on any CPU."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from pydantic import ValidationError

from datagen.bodies import load_body, part_labels
from datagen.bodies.clothed.draping import _nearest_kin, depths
from datagen.bodies.clothed.figure import Figure, helper_quads
from datagen.bodies.clothed.garments import garment_of
from datagen.bodies.clothed.model import ClothedModel, body_faces
from datagen.bodies.clothed.surface import borders
from datagen.bodies.skinning import skin
from datagen.common.errors import BodyError
from datagen.mesh.geometry import edges_of
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses
from datagen.recipe import (
    OUTFITS,
    AnnyBody,
    ClothedBody,
    DrapeSolver,
    GarmentPart,
    OwnOutfit,
    PhenotypeRanges,
    PoseRecipe,
)
from tests.support.shapes.bodies import COARSE, OLD_CPU, identity

ALL_AGES = AnnyBody(topology=COARSE, phenotypes=PhenotypeRanges(age=(0, 1)))


@pytest.fixture(scope="module")
def model() -> ClothedModel:
    body = load_body(ClothedBody(body=ALL_AGES, method="skinned"))
    assert isinstance(body, ClothedModel)
    return body


def test_the_helper_groups_are_those_of_makehuman() -> None:
    quads = helper_quads()
    assert {name: (len(np.unique(its)), len(its)) for name, its in quads.items()} == {
        "body": (13_380, 13_378), "tights": (2_674, 2_650), "skirt": (720, 684),
    }  # fmt: skip


@pytest.mark.parametrize("number", [*range(10), *(pytest.param(n, marks=pytest.mark.slow) for n in range(10, 50))])
def test_parts_are_manifold_finite_and_off_the_body(model: ClothedModel, number: int) -> None:
    parameters = identity(model, number)
    person, outfit = model.person(tuple(parameters)), OUTFITS[list(OUTFITS)[number % 5]]
    garment = person.garment
    assert np.isfinite(garment.rest.vertices).all() and np.array_equal(
        np.unique(garment.part), range(1, len(outfit) + 1)
    )
    faces = garment.faces
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert np.unique(sides, axis=0, return_counts=True)[1].max() == 2
    for part, of in enumerate(outfit, 1):
        mine = faces[(garment.part[faces] == part).all(axis=1)]
        holes = 1 if of.front == "open" else 2 if of.group == "skirt" else 3 if of.high is not None else 4
        assert len(borders(mine)) == holes, f"part {part}: waist and hem; neck, sleeves and hem; waist and two legs"
        assert garment.pinned[garment.part == part].any()
    rest = garment.rest.vertices.astype(np.float32)
    assert depths(rest, person.body.vertices.astype(np.float32), body_faces()).max() < 0.002, "metres within the body"


def test_a_wide_sleeve_has_less_ease_where_it_would_be_in_the_ribs(model: ClothedModel) -> None:
    """Of one of the six of the first fifty people of all ages whose loose shirt was more than 2 mm within them."""
    person = model.person((*identity(model, 24)[:-2], list(OUTFITS).index("loose"), 1.2))
    figure, skin_of = Figure(model._whole.rest(identity(model, 24)[:-2]), model._joints), person.body
    before = garment_of(figure, OUTFITS["loose"], ease=1.2, subdivide=1, detail=1)
    body = skin_of.vertices.astype(np.float32)
    deep = depths(before.rest.vertices.astype(np.float32), body, body_faces())
    changed = (person.garment.rest.vertices != before.rest.vertices).any(axis=1)
    assert deep.max() > 0.005 and changed[deep > 0.002].all() and changed.mean() < 0.1
    assert depths(person.garment.rest.vertices.astype(np.float32), body, body_faces()).max() < 0.002


def test_hems_are_level(model: ClothedModel) -> None:
    parameters = np.array([0.5, 0.3, 0.5, 0.5, 0.5, 0.5])  # a child
    figure = Figure(model._whole.rest(parameters), model._joints)
    garment = garment_of(figure, [GarmentPart(low=0.4, high=2.9, ease=0.0)], ease=1.0, subdivide=0, detail=0)
    rings = borders(garment.faces)
    assert len(rings) == 3
    assert all(np.ptp(garment.uneased[ring, 1]) < 1e-6 for ring in rings), "as cut"
    assert all(np.ptp(garment.rest.vertices[ring, 1]) < 0.004 for ring in rings), "but for what a normal leans"


def test_a_childs_skirt_does_not_hang_on_its_hands(model: ClothedModel) -> None:
    person = model.person((0.5, 0.3, 0.5, 0.5, 0.5, 0.5, list(OUTFITS).index("skirt"), 1.0))
    waist = np.flatnonzero(person.garment.pinned & (person.garment.part == 2))
    chosen = _nearest_kin(person.garment.rest, waist, person.body, body_faces())
    arms = Figure(person.body, model._joints).weight_below("left_shoulder")
    assert arms[body_faces()[chosen]].max() < 0.5
    middles = person.body.vertices[body_faces()[chosen]].mean(axis=1)
    assert np.linalg.norm(middles - person.garment.rest.vertices[waist], axis=1).max() < 0.08


def test_a_childs_skirt_does_not_climb_on_the_shirt_that_bunches_below_its_waist() -> None:
    solver = {"frames": 8, "substeps": 8, "settle": 0, "subdivide": 1}
    recipe = {"body": ALL_AGES.model_dump(), "outfits": ["skirt"], "detail": 1, "solver": solver}
    body = load_body(ClothedBody.model_validate(recipe))
    assert isinstance(body, ClothedModel)
    parameters, still = np.array([0.5, 0.3, 0.5, 0.5, 0.5, 0.5, 0, 1.0]), np.zeros((1, len(JOINTS), 3))
    draped = body.vertices(parameters, Poses(JOINTS, PARENTS, still))[0, body.part_labels(parameters) == 2]
    garment = body.person(tuple(parameters)).garment
    waist = garment.rest.vertices[garment.pinned & (garment.part == 2), 1]
    assert draped[:, 1].max() < waist.max() + 0.005


def test_a_childs_tight_clothes_are_not_stretched_where_the_pattern_is_crowded() -> None:
    """Below the arms and in the crotch, where bending that does not give way pulls short edges half as long again."""
    body = load_body(ClothedBody(body=ALL_AGES, outfits=("tight",), solver=DrapeSolver(subdivide=0)))
    assert isinstance(body, ClothedModel)
    drawn = identity(body, 1)
    person, poses = body.person(tuple(drawn)), draw_poses(PoseRecipe(), range(1, 3))
    edges = edges_of(person.garment.faces)
    for posed in body.vertices(drawn, poses)[:, -len(person.garment.shown) :]:
        stretch = np.linalg.norm(posed[edges[:, 0]] - posed[edges[:, 1]], axis=1) / person.garment.lengths(edges)
        assert np.median(stretch) < 1.02 and np.percentile(stretch, 99) < 1.3


def test_skin_under_clothes_is_not_kept_and_labels_say_what_is_what(model: ClothedModel) -> None:
    bare = load_body(ALL_AGES)
    for number in range(5):
        parameters = identity(model, number)
        labels, faces = part_labels(model, parameters), model.faces(parameters)
        assert labels is not None and (np.diff(labels) >= 0).all() and labels[0] == 0
        assert (labels[faces] == labels[faces][:, :1]).all() and len(labels) == faces.max() + 1
        skin_faces = (labels[faces] == 0).all(axis=1).sum()
        assert 0.1 < skin_faces / len(bare.faces(parameters[:6])) < 1
    assert part_labels(bare, parameters[:6]) is None


def test_skinned_garments_move_as_exact_skinning_has_it(model: ClothedModel) -> None:
    parameters, poses = identity(model, 2), draw_poses(PoseRecipe(), range(2))
    person = model.person(tuple(parameters))
    expected = skin(person.garment.rest, model._whole.world_rotations(poses))[:, person.garment.shown]
    labels = part_labels(model, parameters)
    assert labels is not None and np.array_equal(model.vertices(parameters, poses)[:, labels > 0], expected)


def test_an_outfit_that_there_is_not_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ValidationError, match=r"outfits: there is no 'skrit'; did you mean 'skirt'"):
        ClothedBody(outfits=("skrit",))


def test_a_body_without_helper_geometry_is_refused() -> None:
    with pytest.raises(ValidationError, match=r"body\.family: garments are cut from Anny's helper geometry.*'smpl'"):
        ClothedBody.model_validate({"body": {"family": "smpl"}})


def test_a_cut_that_leaves_nothing_is_refused() -> None:
    own = OwnOutfit(name="x", parts=(GarmentPart(group="skirt", low=3.5),))
    nothing = ClothedBody(body=ALL_AGES, outfits=("x",), own=(own,), method="skinned")
    body = load_body(nothing)
    with pytest.raises(BodyError, match=r"part 1 of the outfit \(skirt, low 3.5, high none\) leaves nothing"):
        body.faces(identity(body))


def test_a_garment_within_the_body_is_refused_when_its_faces_are_asked_for() -> None:
    narrow = OwnOutfit(name="tube", parts=(GarmentPart(low=0.2, high=2.9, flare=0.8, ease=0),))
    body = load_body(ClothedBody(body=ALL_AGES, outfits=("tube",), own=(narrow,)))
    with pytest.raises(BodyError, match=r"of the outfit 'tube' are more than 10 mm inside .* a larger ease or flare$"):
        body.faces(identity(body))


TOP = {"low": 2, "sleeve": 1}


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"own": [{"name": "x", "parts": [TOP]}] * 2}, r"own: there is another outfit called so, too: 'x'; choose"),
        ({"own": [{"name": "tight", "parts": [TOP]}]}, r"own: .* another outfit that comes with the project: 'tight'"),
        ({"own": [{"name": "x", "parts": [TOP | {"high": 1}]}]}, r"low \(2\) must be below high \(1\): nothing lies"),
        ({"own": [{"name": "x", "parts": [TOP | {"high": 2}]}]}, r"low \(2\) must be below high \(2\)"),
        ({"own": [{"name": "x", "parts": [TOP | {"group": "skirt"}]}]}, r"a skirt has no sleeves, but sleeve is 1"),
    ],
)
def test_outfits_of_ones_own_that_make_no_sense_are_refused(body: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        ClothedBody.model_validate(body)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"low": 0.1, "high": 1.4}, r"part 1 of the outfit \(tights, low 0.1, high 1.4\) falls into 2 pieces"),
        ({"low": 0.4, "high": 2.9, "pins": ()}, r"part 1 of the outfit \(tights\) hangs on nothing: pins is \[\]"),
    ],
)
def test_a_part_that_cannot_be_worn_is_refused(model: ClothedModel, part: dict[str, Any], message: str) -> None:
    figure = Figure(model._whole.rest(np.full(6, 0.5)), model._joints)
    with pytest.raises(BodyError, match=message):
        garment_of(figure, [GarmentPart(**part)], ease=1.0, subdivide=0, detail=0)


def test_kernels_are_compiled_for_the_same_bytes_on_every_cpu() -> None:
    options = wp.get_module("datagen.bodies.clothed.kernels").options
    assert (options["fuse_fp"], options["fast_math"], options["cpu_compiler_flags"]) == (False, False, "")


_PROGRAM = """
import hashlib, numpy as np
from datagen.bodies import load_body
from datagen.recipe import AnnyBody, ClothedBody, DrapeSolver, PoseRecipe
from datagen.poses import draw_poses
solver = DrapeSolver(frames=3, substeps=2, settle=30, subdivide=0)
body = load_body(ClothedBody(body=AnnyBody(topology="notoes_collapse3pc"), outfits=("coat",), solver=solver))
parameters = body.draw_identity(np.random.default_rng(3), 0)
print(hashlib.sha256(body.vertices(parameters, draw_poses(PoseRecipe(), range(2))).tobytes()).hexdigest())
"""


def _hash_under(**environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM],
        env={**os.environ, **environment},
        cwd=Path(__file__).parents[4],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()[-1]


@pytest.mark.slow
def test_an_older_cpu_and_more_threads_drape_to_the_same_bytes() -> None:
    assert _hash_under(**OLD_CPU, OMP_NUM_THREADS="1") == _hash_under(OMP_NUM_THREADS="2")


def test_draped_cloth_leaves_the_skin_and_a_second_drape_is_the_first(model: ClothedModel) -> None:
    recipe = ClothedBody.model_validate(
        {"body": ALL_AGES.model_dump(), "outfits": ["skirt"], "solver": {"frames": 6, "substeps": 4, "subdivide": 0}}
    )
    body, turns = load_body(recipe), np.zeros((1, len(JOINTS), 3))
    turns[0, JOINTS.index("left_hip"), 0] = -1.2
    poses, parameters = Poses(JOINTS, PARENTS, turns), np.array([0.5, 0.7, 0.5, 0.5, 0.5, 0.5, 0, 1.0])
    draped, labels = body.vertices(parameters, poses), part_labels(body, parameters)
    assert np.array_equal(draped, body.vertices(parameters, poses))
    skinned = load_body(recipe.model_copy(update={"method": "skinned"})).vertices(parameters, poses)
    apart = np.linalg.norm(draped - skinned, axis=2)[0]
    assert labels is not None and apart[labels == 0].max() == 0 and apart[labels == 2].mean() > 0.02
