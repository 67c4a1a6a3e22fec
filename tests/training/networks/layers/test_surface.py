"""What lies near along a surface: fingers that touch are not near, whatever the vertices' order, number and noise."""

import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from trimesh.remesh import subdivide

from datagen.mesh.geometry import Mesh, edges_of
from tests.support.shapes.samples import offsets_of
from tests.support.three_networks import lively
from training.inference.mesh_reading import surfaces_of
from training.networks import parts
from training.networks.layers import sampling
from training.networks.layers.rigid_parts import hanging_on
from training.networks.layers.sampling import Sample, sample
from training.networks.layers.surface import Surface, _Cells, joined, of_cells, surface_of
from training.networks.parts import Parts


def hairpin(steps: int = 40, *, gap: float = 0.02, joined_at_the_end: bool = True) -> Mesh:
    """Two strips, two units long, that lie on each other and are one at an end: [0, n/2) the lower, then the upper."""
    along, across = np.linspace(-1, 1, steps), np.linspace(-0.1, 0.1, 5)
    lower = np.stack([*np.meshgrid(along, [0.0], across, indexing="ij")], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([lower, lower + np.array([0, gap, 0])])
    corner = (np.arange(steps - 1)[:, None] * 5 + np.arange(4)).ravel()
    strip = np.concatenate([corner[:, None] + np.array(corners) for corners in ((0, 1, 5), (1, 6, 5))])
    last = 5 * (steps - 1) + np.arange(4)
    n = len(lower)
    seam = np.concatenate([last[:, None] + np.array(corners) for corners in ((0, 1, n), (1, n + 1, n))])
    return Mesh(vertices, np.concatenate([strip, strip + n, *([seam] if joined_at_the_end else [])]))


def near(mesh: Mesh) -> np.ndarray:
    """Which vertices [n, n] are near each other."""
    cells, between = surface_of(mesh.vertices, edges_of(mesh.faces))
    found: np.ndarray = between[0][cells[0]][:, cells[0]].numpy()
    return found


@pytest.mark.parametrize("steps", [30, 200])
def test_what_touches_is_near_only_by_the_surface(steps: int) -> None:
    mesh = hairpin(steps)
    found, half = near(mesh), len(mesh.vertices) // 2
    assert (found == found.T).all() and found.diagonal().all()
    at = mesh.vertices[:, 0]
    lower, upper = np.arange(half), np.arange(half, 2 * half)
    far_from_the_seam = at[:half] < 0.6
    assert not found[lower, upper][far_from_the_seam].any()
    assert found[lower, upper][at[:half] > 0.95].all()
    apart = np.abs(mesh.vertices[lower][:, None] - mesh.vertices[lower])
    assert found[:half, :half][(apart < 0.11).all(axis=2)].all()
    assert not found[:half, :half][apart[..., 0] > 0.6].any()


def test_pieces_that_nothing_joins_are_near_and_so_are_points() -> None:
    mesh = hairpin(joined_at_the_end=False)
    half = len(mesh.vertices) // 2
    assert near(mesh)[:half, half:].all() and not near(mesh)[:half, :half].all()
    assert near(Mesh(mesh.vertices, np.empty((0, 3), np.int64))).all()
    corners = mesh.vertices[mesh.faces]
    apart = corners + 0.1 * (corners.mean(axis=1, keepdims=True) - corners)
    assert near(Mesh(apart.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3))).all()


def test_noise_hardly_lengthens_ways() -> None:
    mesh = hairpin(200)
    noise = np.random.default_rng(0).normal(0, 0.01, mesh.vertices.shape)
    calm, noisy = near(mesh), near(Mesh(mesh.vertices + noise, mesh.faces))
    assert (calm & ~noisy).sum() < 0.35 * calm.sum()  # along the vertices' own edges a half is lost


def test_order_does_not_matter_and_seams_of_textures_are_none() -> None:
    mesh = hairpin(60)
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    shuffled = Mesh(mesh.vertices[order], np.argsort(order)[mesh.faces])
    assert (near(shuffled) == near(mesh)[order][:, order]).all()
    half = len(mesh.vertices) // 2
    split = mesh.faces.copy()
    upper = (split >= half).any(axis=1)  # the upper strip and the seam: other vertices, at the same places
    split[upper] += len(mesh.vertices)
    twice = near(Mesh(np.concatenate([mesh.vertices, mesh.vertices]), split))
    assert (twice[: len(mesh.vertices), : len(mesh.vertices)] == near(mesh)).all()


def test_hair_is_near_all_at_once() -> None:
    roots = np.random.default_rng(0).normal(size=(4000, 3))
    fan = np.stack([np.zeros(2000, np.int64), np.arange(1, 4001, 2), np.arange(2, 4001, 2)], axis=1)
    assert surface_of(np.concatenate([[[0.0, 0, 0]], roots]), edges_of(fan)).near.shape == (1, 1, 1)


@pytest.mark.parametrize("steps", [100, 400])
def test_layers_that_touch_all_over_hear_of_themselves(steps: int) -> None:
    mesh = hairpin(steps)
    vertices = torch.from_numpy(mesh.vertices).float()[None]
    drawn = sample(vertices, surface_of(mesh.vertices, edges_of(mesh.faces)))
    kept = drawn.vertices[0][drawn.masses[0] > 0]
    assert abs(float((kept[:, 1] > 0.01).float().mean()) - 0.5) < 0.1
    assert offsets_of(vertices, drawn).abs().max() < 2.5


def test_offsets_of_one_finger_are_not_the_others() -> None:
    mesh = hairpin(60)
    vertices = torch.from_numpy(mesh.vertices).float()[None]
    upper = torch.arange(len(mesh.vertices)) >= len(mesh.vertices) // 2
    told = surface_of(mesh.vertices, edges_of(mesh.faces))
    aside = [offsets_of(vertices, drawn)[0, :, 1] for drawn in (sample(vertices), sample(vertices, told))]
    far = vertices[0, :, 0] < 0.4
    assert (aside[0][far & upper].mean() - aside[0][far & ~upper].mean()).abs() > 0.1  # away from each other
    assert (aside[1][far & upper].mean() - aside[1][far & ~upper].mean()).abs() < 0.02  # as if it were alone


def two_pins() -> tuple[torch.Tensor, Surface]:
    """Hairpins of 3,000 vertices, thinner and thicker, and what is near along them."""
    pins = [hairpin(300), hairpin(300, gap=0.3)]
    told = joined([surface_of(pin.vertices, edges_of(pin.faces)) for pin in pins])
    return torch.stack([torch.from_numpy(pin.vertices) for pin in pins]), told


def test_offsets_are_from_the_mean_of_what_is_near_along_the_surface() -> None:
    vertices, told = two_pins()
    drawn = sample(vertices, told)
    assert not (drawn.masses > 0).all() and (drawn.masses > 0).any()
    away = torch.cdist(vertices, drawn.vertices)
    near = (-0.5 * (away / 0.1).square()).exp() * drawn.masses[:, None]
    cells = told.cells.gather(1, drawn.rows)
    for pin in range(2):
        near[pin] *= torch.where(told.near[pin][told.cells[pin]][:, cells[pin]], 1.0, 1e-4)
    middle = near @ drawn.vertices / near.sum(2, keepdim=True)
    torch.testing.assert_close(offsets_of(vertices, drawn), (vertices - middle) * 20, rtol=0, atol=1e-3)


def test_a_gpu_hears_all_of_the_sample_and_is_asked_for_no_value(monkeypatch: pytest.MonkeyPatch) -> None:
    network = lively("parts", dtype=torch.float64)
    assert isinstance(network, Parts)
    vertices, told = two_pins()
    drawn = sample(vertices, told)
    expected = network.read(drawn, vertices)
    monkeypatch.setattr(sampling, "_within_reach", lambda *_: (None, None))  # as it answers there
    for one, other in zip(network.read(drawn, vertices), expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-4)
    with FakeTensorMode(allow_non_fake_inputs=True) as fake:
        unknown, surface = fake.from_tensor(vertices), Surface(*map(fake.from_tensor, told))
        assert network.read(sample(unknown, surface), unknown).rest.shape == vertices.shape


def test_a_sample_that_did_not_move_is_what_it_was() -> None:
    vertices, told = two_pins()
    drawn = sample(vertices, told)
    again = drawn.moved(drawn.vertices)
    assert not (drawn.masses > 0).all()
    torch.testing.assert_close(again.masses, drawn.masses)
    torch.testing.assert_close(offsets_of(vertices, again), offsets_of(vertices, drawn))


def test_a_mesh_of_a_batch_is_told_what_it_is_told_alone() -> None:
    network = lively("parts").eval()
    assert isinstance(network, Parts)
    pins = [hairpin(40), hairpin(40, gap=0.05), hairpin(40, joined_at_the_end=False)]
    sources = [Mesh(pin.vertices @ np.diag([0.5, 4, 3]), pin.faces) for pin in pins]

    def output(places: slice, *, told: bool) -> torch.Tensor:
        source, target = (
            torch.stack([torch.from_numpy(mesh.vertices).float() for mesh in its[places]]) for its in (sources, pins)
        )
        known = surfaces_of(network, sources=sources[places], targets=pins[places]) if told else {}
        found: torch.Tensor = network(source=source, target=target, **known)
        return found

    together = output(slice(None), told=True)
    for place in range(len(pins)):
        alone = output(slice(place, place + 1), told=True)
        torch.testing.assert_close(together[place, None], alone, rtol=0, atol=1e-5)
    assert (output(slice(None), told=False) - together).abs().amax((1, 2))[:2].min() > 1e-3


def test_what_is_folded_up_is_as_large_as_it_is_long_along_the_surface() -> None:
    """A strip of 2 x 1, flat or in two layers: near is what 0.35 of its size joins, one if flat, folded 2.1 / 2.8."""
    across, along = np.linspace(0, 1, 21), np.linspace(0, 2, 41)
    layer = np.minimum(along // 1, 1)
    there = along - layer
    flat, folded = (
        np.concatenate([np.repeat(np.stack(places, axis=1), 21, axis=0), np.tile(across, 41)[:, None]], axis=1)
        for places in ((along, 0 * along), (np.where(layer % 2, 1 - there, there), 0.15 * layer))
    )
    corner = (np.arange(40)[:, None] * 21 + np.arange(20)).ravel()[:, None]
    edges = edges_of(np.concatenate([corner + np.array(corners) for corners in ((0, 1, 21), (1, 22, 21))]))
    middle = np.arange(10, 41 * 21, 21)

    def reach(vertices: np.ndarray, order: np.ndarray) -> float:
        """How far along the strip what is near reaches to either side, in the mean."""
        back = order.argsort()
        cells, between = surface_of(vertices[order], back[edges])
        of_middle = cells[0, back[middle]]
        is_near = between[0][of_middle][:, of_middle].numpy()
        return float(np.mean([along[row].max() - along[row].min() for row in is_near[10:30]])) / 2

    as_listed, shuffled = np.arange(len(flat)), np.random.default_rng(0).permutation(len(flat))
    assert 0.28 < reach(flat, as_listed) < 0.42
    assert 0.22 < reach(folded, as_listed) < 0.32  # by its box alone 0.15 to 0.2
    assert reach(folded, shuffled) == reach(folded, as_listed)


def test_the_longest_way_is_found_from_the_middle_and_counts_only_so_much() -> None:
    """A long coil beside a plate: both are told apart, though a way along the coil is fifteen times the box' half."""
    turn = np.linspace(0, 30, 4000)
    coil = np.stack([0.5 * np.cos(turn), turn / 30, 0.5 * np.sin(turn)], axis=1)
    line = np.stack([np.arange(3999), np.arange(1, 4000)], axis=1)
    plate = np.stack([*np.meshgrid(np.linspace(-1, 1, 30), [0.0], np.linspace(-1, 1, 30), indexing="ij")], axis=-1)
    number = np.arange(900).reshape(30, 30)
    grid = [
        np.stack([a.ravel(), b.ravel()], axis=1) for a, b in ((number[1:], number[:-1]), (number.T[1:], number.T[:-1]))
    ]
    vertices = np.concatenate([coil, plate.reshape(-1, 3) - (0, 0.2, 0)])
    cells, between = surface_of(vertices, np.concatenate([line, *(edges + 4000 for edges in grid)]))
    of_plate = cells[0, 4000:]
    assert len(set(of_plate.tolist())) > 20  # 400 cubes of 0.1 without the coil, 100 of twice that
    assert between[0][of_plate][:, of_plate].float().mean() < 0.5
    found = _Cells.of(coil, line, 0.1)
    middle_first = _Cells.of(np.roll(coil, 2000, axis=0), (line + 2000) % 4000, 0.1)
    assert found.longest_way() == pytest.approx(15, rel=0.1)
    assert middle_first.longest_way() == pytest.approx(found.longest_way(), rel=0.02)


def test_surfaces_of_several_meshes_are_padded() -> None:
    small, large = (surface_of(pin.vertices, edges_of(pin.faces)) for pin in (hairpin(20), hairpin(60)))
    both = joined([small, large])
    assert both.cells.shape == (2, 600) and both.near.shape[1] == large.near.shape[1]
    again = both.of([0], 200)
    size = small.near.shape[1]
    assert torch.equal(again.cells, small.cells) and torch.equal(again.near[:, :size, :size], small.near)
    rows = torch.tensor([[3, 150, 7]])
    expected = small.near[0][small.cells[0]][:, small.cells[0, rows[0]]]
    assert torch.equal(of_cells(small.apart(rows), small.cells)[0] == 0, expected)
    assert torch.equal(small.at(rows).cells, small.cells[:, rows[0]])


def test_crumbs_are_one_cell_that_is_near_to_all() -> None:
    """Triangles that share no vertices would else be cells each, and nothing near anything."""
    mesh, random = hairpin(60), np.random.default_rng(0)
    low, high = 0.9 * mesh.vertices.min(axis=0), 0.9 * mesh.vertices.max(axis=0)
    crumbs = random.uniform(low, high, (20, 1, 3)) + 0.001 * random.normal(size=(20, 3, 3))
    vertices = np.concatenate([mesh.vertices, crumbs.reshape(-1, 3)])
    faces = np.concatenate([mesh.faces, len(mesh.vertices) + np.arange(60).reshape(20, 3)])
    alone, both = (surface_of(each, edges_of(its)) for each, its in ((mesh.vertices, mesh.faces), (vertices, faces)))
    assert both.near.shape[1] == alone.near.shape[1] + 1
    assert len(set(both.cells[0, len(mesh.vertices) :].tolist())) == 1
    assert near(Mesh(vertices, faces))[len(mesh.vertices) :].all()
    found = near(Mesh(vertices, faces))[: len(mesh.vertices), : len(mesh.vertices)]
    assert (found == near(mesh)).all()


ALL = torch.eye(3)
"""Three parts, each a root."""


def two_parts(mesh: Mesh, few: slice) -> torch.Tensor:
    """Logits [1, n, 3] of a hairpin's strips, a part each; the shares of a few vertices of the first are exchanged."""
    logits = torch.tensor([4.0, 0.0, 2.0]).repeat(len(mesh.vertices), 1)
    logits[len(logits) // 2 :] = logits[len(logits) // 2 :, [1, 0, 2]]
    logits[few] = logits[few][:, [1, 0, 2]]
    return logits[None]


@pytest.mark.parametrize("joined_at_the_end", [True, False])
def test_vertices_far_from_the_rest_of_a_part_along_the_surface_do_not_follow_it(
    joined_at_the_end: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, few = hairpin(joined_at_the_end=joined_at_the_end), slice(3, 6)
    vertices, half = torch.from_numpy(mesh.vertices).float()[None], len(mesh.vertices) // 2
    logits, drawn = two_parts(mesh, few), sample(vertices, surface_of(mesh.vertices, edges_of(mesh.faces)))
    weights, as_read = parts._weights(logits, drawn, ALL)[0], logits.softmax(2)[0]
    assert torch.equal(parts._weights(logits, sample(vertices), ALL)[0], as_read)
    if not joined_at_the_end:
        assert torch.equal(weights, as_read), "what no edge joins may be of one part"
        return
    assert as_read[few].argmax(1).eq(1).all() and weights[few].argmax(1).eq(2).all() and weights[few, 1].eq(0).all()
    torch.testing.assert_close(weights.sum(1), torch.ones(2 * half))
    others = torch.tensor([vertex for vertex in range(half) if vertex not in range(*few.indices(half))])
    assert weights[others].argmax(1).eq(0).all() and weights[half:].argmax(1).eq(1).all()
    monkeypatch.setattr(parts, "_LEAST_NEAR", 0.6)
    nowhere = parts._weights(logits, drawn, ALL)[0]
    assert nowhere.isfinite().all() and torch.equal(nowhere[: half // 10], as_read[: half // 10]), "no part is near"


def legs(mesh: Mesh) -> torch.Tensor:
    """The part [n] of each vertex of a hairpin: 0, the pelvis, where its strips are one, thigh, shank and foot along
    each, 1 to 3 and 4 to 6.
    """
    part = torch.from_numpy(3 - np.digitize(mesh.vertices[:, 0], (-0.5, 0.1, 0.7)))
    return torch.where((part > 0) & (torch.arange(len(part)) >= len(part) // 2), part + 3, part)


@pytest.mark.parametrize("sure", [4.0, 20.0])
@pytest.mark.parametrize(
    ("shank", "foot"),
    [
        pytest.param(0.0, 0.5, id="a foot"),
        pytest.param(0.26, 0.125, id="a third of a shank with a quarter of a foot"),
        pytest.param(0.6, 0.5, id="a whole shank with its foot"),
    ],
)
def test_what_lies_at_the_other_leg_and_hangs_on_none_of_its_parts_is_not_of_that_leg(
    shank: float, foot: float, sure: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The left leg's vertices from a foot's way below the ankle to a shank's way above it are taken for the right's."""
    mesh = hairpin()
    true, hangs_on = legs(mesh), hanging_on([0, 0, 1, 2, 0, 4, 5])
    x = torch.from_numpy(mesh.vertices[:, 0])
    wrong = (true > 0) & (true < 4) & (x > -0.5 - foot - 0.01) & (x < -0.5 + shank)
    assert wrong.sum() > 20
    logits = 2 * torch.eye(7)[true] + sure * torch.eye(7)[torch.where(wrong, true + 3, true)]
    drawn = sample(torch.from_numpy(mesh.vertices).float()[None], surface_of(mesh.vertices, edges_of(mesh.faces)))
    weights = parts._weights(logits[None], drawn, hangs_on)[0]
    assert torch.equal(weights.argmax(1), true) and weights[wrong].gather(1, true[wrong, None] + 3).eq(0).all()
    monkeypatch.setattr(parts, "_LEAST_HOLDING", 0.0)
    by_what_is_near = parts._weights(logits[None], drawn, hangs_on)[0]
    assert by_what_is_near[wrong].argmax(1).ge(4).all(), "else this shows nothing"


def test_all_of_a_long_chain_of_parts_hangs_on_its_root() -> None:
    """Twenty-four along the hairpin, from the free end of one strip to that of the other."""
    mesh, count = hairpin(), 24
    x, first = mesh.vertices[:, 0], np.arange(len(mesh.vertices)) < len(mesh.vertices) // 2
    way = np.where(first, 1 + x, 3 - x) / 4
    part = torch.from_numpy(np.clip((way * count).astype(int), 0, count - 1))
    logits, chain = 4 * torch.eye(count)[part], hanging_on([0, *range(count - 1)])
    drawn = sample(torch.from_numpy(mesh.vertices).float()[None], surface_of(mesh.vertices, edges_of(mesh.faces)))
    network = Parts(joints={f"{n}": f"{n - 1}" if n else None for n in range(count)}, width=8, token_width=8, blocks=1)
    assert network._steps == 23 and torch.equal(network.hangs_on, chain)
    assert torch.equal(parts._weights(logits[None], drawn, chain, network._steps)[0].argmax(1), part)
    assert not torch.equal(parts._weights(logits[None], drawn, chain, 3)[0].argmax(1), part), "not in fewer steps"


def test_which_part_is_near_does_not_depend_on_how_finely_the_mesh_is_meshed() -> None:
    """One end of the hairpin has nearly all vertices of the part, and no more of its surface than the other."""
    mesh = hairpin()
    fine = np.flatnonzero((mesh.vertices[mesh.faces, 0] > 0.7).all(axis=1))
    for _ in range(3):
        count = len(mesh.faces) - len(fine)
        mesh = Mesh(*subdivide(mesh.vertices, mesh.faces, fine))
        fine = np.arange(count, len(mesh.faces))
    far = torch.from_numpy(mesh.vertices[:, 0] < -0.6)
    logits = torch.tensor([4.0, -9.0, -9.0]).repeat(len(mesh.vertices), 1)
    logits[far, 1] = 2
    drawn = sample(torch.from_numpy(mesh.vertices).float()[None], surface_of(mesh.vertices, edges_of(mesh.faces)))
    assert far.float().mean() < parts._LEAST_NEAR, "else this shows nothing"
    torch.testing.assert_close(parts._weights(logits[None], drawn, ALL)[0], logits.softmax(1), rtol=0, atol=1e-4)


def test_a_part_hangs_on_itself_and_on_its_parent() -> None:
    expected = [[1, 1, 0, 1], [0, 1, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert hanging_on([0, 0, 1, 0]).tolist() == expected


def test_a_part_too_large_to_lie_near_anything_holds_what_hangs_on_it() -> None:
    mesh = hairpin(60)
    vertices = torch.from_numpy(mesh.vertices).float()[None]
    head = vertices[0, :, 0].lt(-0.7) & torch.arange(len(mesh.vertices)).lt(len(mesh.vertices) // 2)
    logits = 4 * torch.eye(2)[head.long()]
    drawn = sample(vertices, surface_of(mesh.vertices, edges_of(mesh.faces)))
    weights = parts._weights(logits[None], drawn, hanging_on([0, 0]))[0]
    assert torch.equal(weights.argmax(1), head.long())
    assert weights[head, 0].gt(0).any(), "the trunk holds itself at the neck"


@torch.no_grad()
def test_a_mesh_is_posed_to_rest_by_parts_that_are_near(monkeypatch: pytest.MonkeyPatch) -> None:
    network, mesh, posed = lively("parts").eval(), hairpin(), list[torch.Tensor]()
    assert isinstance(network, Parts)
    vertices = torch.from_numpy(mesh.vertices).float()[None]
    to_rest = network.posed_to_rest
    monkeypatch.setattr(
        network, "posed_to_rest", lambda at, reading: (posed.append(reading.logits), to_rest(at, reading))[1]
    )
    monkeypatch.setattr(parts, "_of_near", lambda logits, near, surface: torch.full_like(logits, 7.0))
    for surface in (surface_of(mesh.vertices, edges_of(mesh.faces)), None):
        drawn = sample(vertices, surface)
        network.read_again(drawn, network.read(drawn))
    assert posed[0].eq(7).all() and not posed[1].eq(7).any()


@torch.no_grad()
def test_targets_and_projections_are_posed_by_parts_that_are_near(monkeypatch: pytest.MonkeyPatch) -> None:
    network, mesh = lively("parts").eval(), hairpin()
    assert isinstance(network, Parts)
    vertices = torch.from_numpy(mesh.vertices).float()[None]
    surface = surface_of(mesh.vertices, edges_of(mesh.faces))
    drawn = sample(vertices, surface)
    asked = list[Sample]()

    def weights_of(logits: torch.Tensor, drawn: Sample, hangs_on: torch.Tensor, steps: int) -> torch.Tensor:
        assert hangs_on is network.hangs_on and steps == 8
        asked.append(drawn)
        return torch.zeros_like(logits)

    monkeypatch.setattr(parts, "_weights", weights_of)
    for weights in (network.read_target(vertices, surface).weights, network.skinning_weights(drawn, vertices)):
        assert weights.shape == (1, len(mesh.vertices), len(network.joints)) and not weights.any()
    assert len(asked) == 2 and asked[1] is drawn and torch.equal(asked[0].rows, drawn.rows)
