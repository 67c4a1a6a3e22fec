"""Anny's rigs and topologies: one SMPL pose draws alike on all of them.

What loads another rig than the default's or a large topology is slow: a fresh cache takes ten seconds for each rig.
"""

from typing import Any, get_args

import numpy as np
import pytest
from scipy.spatial import cKDTree

from datagen.bodies import BodyModel, load_body
from datagen.bodies.anny.rigs import Bones, carriers, parents_first, t_pose_corrections
from datagen.mesh.geometry import Mesh, check_mesh
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses
from datagen.recipe import AnnyBody, AnnyRig, AnnyTopology, PhenotypeRanges, PoseRecipe
from tests.support.shapes.bodies import identity

RIGS: tuple[AnnyRig, ...] = get_args(AnnyRig)
TOPOLOGIES: tuple[AnnyTopology, ...] = get_args(AnnyTopology)
VERTICES = {
    "anny": 13_718,
    "notoes": 12_272,
    "notoes_collapse10pc": 1_229,
    "notoes_collapse5pc": 615,
    "notoes_collapse3pc": 369,
    "soma": 18_056,
    "makehuman": 19_158,
}
ALL_AGES = PhenotypeRanges(age=(0.0, 1.0))
POSES = draw_poses(PoseRecipe(), range(12))
T_POSE = Poses(JOINTS, PARENTS, np.zeros((1, len(JOINTS), 3)))


def body(topology: AnnyTopology = "notoes_collapse3pc", **options: Any) -> BodyModel:
    return load_body(AnnyBody(topology=topology, **options))


class TestRigs:
    @pytest.mark.parametrize("rig", RIGS)
    def test_every_smpl_joint_has_a_bone(self, rig: AnnyRig) -> None:
        assert set(carriers(rig).values()) == set(JOINTS)

    def test_parents_come_first_whatever_their_order(self) -> None:
        """A shuffled rig describes the same tree, with every parent before its children."""
        labels = ["Hips", "LeftUpLeg", "LeftLeg", "Spine", "Spine1", "Extra", "Neck"]
        parents = [-1, 0, 1, 0, 3, 4, 5]
        shuffled = np.random.default_rng(3).permutation(len(labels))
        assert any(np.argsort(shuffled)[parents[bone]] > place for place, bone in enumerate(shuffled) if bone)
        place = np.argsort(shuffled)
        moved = [int(place[parents[bone]]) if parents[bone] >= 0 else -1 for bone in shuffled]
        bones = Bones.of("mixamo", [f"mixamorig:{labels[bone]}" for bone in shuffled], moved)
        assert all(parent < bone for bone, parent in enumerate(bones.parents))
        back = [labels[shuffled[bone]] for bone in bones.order]
        tree = {label: back[parent] if parent >= 0 else None for label, parent in zip(back, bones.parents, strict=True)}
        assert tree == {
            label: labels[parent] if parent >= 0 else None for label, parent in zip(labels, parents, strict=True)
        }
        assert (
            dict(zip(back, bones.joints, strict=True))["Spine1"] == "spine2"
            and bones.joints[back.index("Extra")] is None
        )

    def test_an_ordered_rig_stays_as_it_is(self) -> None:
        assert parents_first([-1, 0, 1, 0]).tolist() == [0, 1, 2, 3]

    def test_its_52_bones_make_30_parts(self) -> None:
        """Thumbs, metacarpals and twists move as what they hang on does; fingers of a hand differ in their pivots."""
        model = body()
        rig = model.rig(identity(model), JOINTS)
        assert rig is not None and len(rig.names) == 30 and {JOINTS[driver] for driver in rig.drivers} == set(JOINTS)
        knuckles = {f"LeftHand{finger}1" for finger in ("Index", "Middle", "Ring", "Pinky")}
        assert {name for name in rig.names if "LeftHand" in name} == {"LeftHand", *knuckles}

    def test_corrections_straighten_bent_arms(self) -> None:
        """An A-pose with bent elbows, twist bones between: the corrected bones point straight to their sides."""
        chain = {
            "shoulder": (0.2, 0.5, 0.0),
            "twist": (0.3, 0.4, 0.0),
            "elbow": (0.4, 0.3, 0.0),
            "wrist": (0.45, 0.1, 0.1),
        }
        names: list[str | None] = ["pelvis"]
        places = [(0.0, 0.0, 0.0)]
        for side, sign in (("left", 1), ("right", -1)):
            names += [None if part == "twist" else f"{side}_{part}" for part in chain]
            places += [(sign * x, y, z) for x, y, z in chain.values()]
        parents = (-1, 0, 1, 2, 3, 0, 5, 6, 7)
        joints = np.array(places)
        corrections = t_pose_corrections(Bones(np.arange(9), tuple(map(str, names)), tuple(names), parents), joints)
        for bone, tip, sign in ((1, 3, 1), (3, 4, 1), (5, 7, -1), (7, 8, -1)):
            direction = corrections[bone] @ (joints[tip] - joints[bone])
            assert direction / np.linalg.norm(direction) == pytest.approx([sign, 0, 0], abs=1e-9)
        assert np.array_equal(corrections[0], np.eye(3)) and np.array_equal(corrections[1], corrections[2])

    @pytest.mark.slow
    @pytest.mark.parametrize("rig", RIGS)
    def test_the_zero_pose_is_a_t_pose(self, rig: AnnyRig) -> None:
        vertices = body(rig=rig).vertices(identity(body(rig=rig)), T_POSE)[0]
        for side in (1, -1):
            arm = vertices[vertices[:, 0] * side > 0.55 * np.abs(vertices[:, 0]).max()]
            assert np.ptp(arm[:, 1]) < 0.15 and np.ptp(arm[:, 2]) < 0.25, "the arm is level and points sideways"

    @pytest.mark.slow
    @pytest.mark.parametrize(("rig", "bound"), [("anny", 0.015), ("cmu_mb", 0.015), ("soma", 0.035)])
    def test_one_pose_draws_alike_on_every_rig(self, rig: AnnyRig, bound: float) -> None:
        """Mean distance of corresponding vertices from the Mixamo rig's, over identities of all ages and NPT's poses.

        Measured: 10 mm for anny and cmu_mb, 25 mm for soma, whose joints lie up to 12 cm from Mixamo's (chest). That
        is how differently the rigs bend skin; another pose is 30 cm away.
        """
        meshes = {name: np.stack([self.centred(name, number) for number in range(3)]) for name in (rig, "mixamo")}
        distance = np.linalg.norm(meshes[rig] - meshes["mixamo"], axis=-1)
        other_pose = np.linalg.norm(meshes[rig] - np.roll(meshes["mixamo"], 1, axis=1), axis=-1)
        assert distance.mean() < bound and distance.mean(axis=-1).max() < 2.5 * bound
        assert other_pose.mean() > 5 * bound

    @staticmethod
    def centred(rig: AnnyRig, number: int) -> np.ndarray:
        """Vertices [pose, vertex, 3] with the bounding box about the origin, as networks see them."""
        model = body("notoes_collapse10pc", rig=rig, phenotypes=ALL_AGES)
        vertices = model.vertices(identity(model, number), POSES).astype(float)
        return vertices - (vertices.max(axis=1, keepdims=True) + vertices.min(axis=1, keepdims=True)) / 2

    @pytest.mark.slow
    @pytest.mark.parametrize("rig", [rig for rig in RIGS if rig != "mixamo"])
    def test_every_joint_moves_what_it_moves_on_mixamo(self, rig: AnnyRig) -> None:
        """Displacements by each joint alone, as one vector: their cosine with Mixamo's is above 0.97.

        Toes and fingers, where rigs differ in bones and weights, are above 0.75 (measured 0.76 to 1).
        """
        turned = np.zeros((3 * len(JOINTS), len(JOINTS), 3))
        for joint in range(len(JOINTS)):
            turned[3 * joint + np.arange(3), joint, np.arange(3)] = np.radians(30)
        ours, theirs = (self.moved(name, Poses(JOINTS, PARENTS, turned)) for name in (rig, "mixamo"))
        cosine = (ours * theirs).sum(axis=1) / np.linalg.norm(ours, axis=1) / np.linalg.norm(theirs, axis=1)
        for name, value in zip(JOINTS, cosine, strict=True):
            assert value > (0.75 if name.endswith(("hand", "foot")) else 0.97), name

    @staticmethod
    def moved(rig: AnnyRig, poses: Poses) -> np.ndarray:
        model = body("notoes_collapse10pc", rig=rig)
        vertices = model.vertices(identity(model), poses).astype(float)
        return (vertices - model.vertices(identity(model), T_POSE)).reshape(len(JOINTS), -1)


@pytest.mark.slow
@pytest.mark.parametrize("topology", TOPOLOGIES)
@pytest.mark.parametrize("rig", RIGS)
def test_every_topology_and_rig_draws_the_same_body(topology: AnnyTopology, rig: AnnyRig) -> None:
    """Every vertex of a surface lies near one of the finest surface in the same pose; faces look outwards.

    Measured: nearest vertices are 0 to 7 mm apart on average, 12 mm on the soma rig.
    """
    model = body(topology, rig=rig)
    reference = body("anny")
    parameters, faces = identity(model), model.faces(identity(model))
    vertices, expected = (its.vertices(parameters, POSES[:3]) for its in (model, reference))
    assert vertices.shape == (3, VERTICES[topology], 3)
    on_surface = np.unique(faces)
    assert topology == "makehuman" or len(on_surface) == VERTICES[topology], "every vertex belongs to a face"
    for ours, theirs in zip(vertices, expected, strict=True):
        check_mesh(Mesh(ours, faces), name=f"{topology} {rig}")
        assert cKDTree(theirs).query(ours[on_surface])[0].mean() < (0.02 if rig == "soma" else 0.01)
        corners = ours[faces].astype(float)
        volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        assert 0.03 < volume < 0.12, "cubic metres, positive where faces look outwards"
