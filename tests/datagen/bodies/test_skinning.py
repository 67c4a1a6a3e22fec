"""Skinning: equal to the textbook formula, and exact, so that nothing about the machine shows in the bytes."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.bodies import load_body, skinning
from datagen.bodies.skinning import Rest, remembering, skin
from datagen.common.seeding import Stream, generator
from datagen.poses import draw_poses
from datagen.recipe import AnnyBody, LegBody, PoseRecipe
from tests.support.shapes.bodies import OLD_CPU

PARENTS = (-1, 0, 1, 1)


def rest(size: float = 1.0, seed: int = 0) -> Rest:
    random = np.random.default_rng(seed)
    weights = random.uniform(size=(50, 4)) * (random.uniform(size=(50, 4)) < 0.7)
    weights[:, 0] += 0.1
    weights /= weights.sum(axis=1, keepdims=True)
    return Rest(size * random.normal(size=(50, 3)), size * random.normal(size=(4, 3)), weights, PARENTS)


def rotations(count: int, seed: int = 1) -> np.ndarray:
    return Rotation.random(count * 4, random_state=seed).as_matrix().reshape(count, 4, 3, 3)


def literally(rest: Rest, world: np.ndarray, correctives: np.ndarray) -> np.ndarray:
    """One vertex, one joint at a time: v' = sum_k w_k (R_k (v + d - j_k) + j'_k)."""
    posed = np.empty((len(world), len(rest.vertices), 3))
    for pose, turns in enumerate(world):
        places = np.empty((4, 3))
        for joint, parent in enumerate(rest.parents):
            bone = rest.joints[joint] - rest.joints[parent]
            places[joint] = rest.joints[joint] if parent < 0 else places[parent] + turns[parent] @ bone
        for number, vertex in enumerate(rest.vertices):
            moved = [turns[k] @ (vertex + correctives[pose, number] - rest.joints[k]) + places[k] for k in range(4)]
            posed[pose, number] = np.asarray(rest.weights)[number] @ np.array(moved)
    return posed


@pytest.mark.parametrize("size", [0.5, 1.0, 30.0])
@pytest.mark.parametrize("corrected", [False, True])
def test_it_is_linear_blend_skinning(size: float, corrected: bool) -> None:
    body, world = rest(size), rotations(5)
    correctives = 0.05 * np.random.default_rng(2).normal(size=(5, 50, 3)) * corrected
    expected = literally(body, world, correctives)
    found = skin(body, world, correctives if corrected else None)
    assert np.abs(found - expected).max() < (3e-6 if size <= 1 else 1e-5 * size)  # beyond 4 m the steps are wider


def test_many_poses_are_what_single_ones_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(skinning, "VERTICES_AT_ONCE", 32 * 50)
    world = rotations(70)
    together = skin(rest(), world)
    assert all(np.array_equal(together[i : i + 1], skin(rest(), world[i : i + 1])) for i in (0, 31, 32, 69))


def test_few_joints_are_skinned_alike_however_many_poses_a_product_has(monkeypatch: pytest.MonkeyPatch) -> None:
    body, world = load_body(LegBody()), rotations(70)[:, :2]
    legs = body.rest(body.draw_identity(np.random.default_rng(0), 0))  # type: ignore[attr-defined]
    together = skin(legs, world)
    monkeypatch.setattr(skinning, "_ONE_THREAD", 3 * 8 * len(legs.vertices) * 16)
    assert np.array_equal(skin(legs, world), together)


def test_a_body_remembers_the_last_identity_alone() -> None:
    asked: list[float] = []
    remembered = remembering(lambda parameters: asked.append(parameters[0]) or rest())  # type: ignore[func-returns-value]
    found = [remembered(np.array([number])) for number in (1.0, 1.0, 2.0, 2.0, 1.0)]
    assert asked == [1.0, 2.0, 1.0] and found[0] is found[1] and found[0] is not found[4]


def test_errors_in_the_last_bits_of_its_input_do_not_show() -> None:
    """Another CPU or BLAS computes rest vertices and sines with other last bits: the output's bytes are the same."""
    body, world = rest(), rotations(20)
    noise = np.random.default_rng(3)

    def shaken(values: np.ndarray) -> np.ndarray:
        return values * (1 + 1e-15 * noise.choice([-1, 0, 1], size=values.shape))

    other = Rest(shaken(body.vertices), shaken(body.joints), body.weights, PARENTS)
    assert np.array_equal(skin(body, world), skin(other, shaken(world)))


def test_the_order_of_summation_does_not_show() -> None:
    body, world = rest(), rotations(20)
    order = [0, 1, 3, 2]  # the two leaves swapped: every weighted sum runs in another order
    swapped = Rest(body.vertices, body.joints[order], np.asarray(body.weights)[:, order], PARENTS)
    assert np.array_equal(skin(body, world), skin(swapped, world[:, order]))


def digest() -> str:
    """Of Anny's coarse people in poses enough for several batches of them."""
    body, poses, made = load_body(AnnyBody(topology="notoes_collapse3pc")), draw_poses(PoseRecipe(), range(40)), b""
    for number in range(3):
        made += body.vertices(body.draw_identity(generator(0, Stream.IDENTITY, number), number), poses).tobytes()
    return hashlib.sha256(made).hexdigest()


def test_an_older_cpu_gives_the_same_bytes() -> None:
    """OpenBLAS, NumPy and PyTorch restricted to what a CPU of 2008 can do, against this machine's own best."""
    words = [sys.executable, "-c", "from tests.datagen.bodies import test_skinning; print(test_skinning.digest())"]
    root = Path(__file__).parents[3]
    old = {**os.environ, **OLD_CPU, "OMP_NUM_THREADS": "2"}
    done = subprocess.run(words, env=old, cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == digest()
