"""What the parts network learns from: large errors count as they are, small ones as their squares."""

import pytest
import torch
from torch import Tensor

from training.networks.layers.rigid_parts import box, turned_about
from training.networks.parts import Parts, Reading
from training.objectives.parts import Posed, parts_loss


class Knowing(Parts):
    """Reads what it is told to: of both meshes once, and again."""

    def __init__(self, *readings: tuple[Reading, Reading]) -> None:
        super().__init__(joints={"pelvis": None, "head": "pelvis"}, width=8, token_width=8, blocks=1)
        self._readings = iter(readings)
        self.read_of = list[tuple[Tensor, Tensor]]()

    def read_pair(self, source: Tensor, target: Tensor, *_: object) -> tuple[Reading, Reading]:
        self.read_of.append((source, target))
        return next(self._readings)


VERTICES = torch.tensor([[[-1.0, -1, -0.5], [1, -1, 0.5], [1, 1, 0.2], [-1, 1, -0.2]]])


def losses(*, turn: float = 0, shift: float = 0, present: tuple[float, float] = (1, 1)) -> dict[str, Tensor]:
    """Of a source of which the second part is read as turned by radians, and its joint as shifted."""
    weights = torch.tensor([[[1.0, 0], [1, 0], [0, 1], [0, 1]]])
    posed = Posed(
        weights=weights,
        rest=VERTICES,
        rest_joints=torch.zeros(1, 2, 3),
        rotations=torch.eye(3).expand(1, 2, 3, 3),
        joints=torch.zeros(1, 2, 3),
        present=torch.tensor([present]),
    )
    right = Reading(1e4 * weights, VERTICES, posed.rotations, posed.joints)
    rotations = torch.stack([torch.eye(3), turned_about(torch.tensor([[0.0, 0.0, turn]]))[0]])[None]
    read = right._replace(rotations=rotations, joints=torch.tensor([[[0.0, 0, 0], [shift, 0, 0]]]))
    total, named = parts_loss(
        Knowing((read, right)), source=VERTICES, target=VERTICES, truth=VERTICES, posed=(posed, posed)
    )
    return {**named, "total": total}


def test_what_is_read_rightly_has_no_loss() -> None:
    assert all(value.abs() < 1e-6 for value in losses().values())


@pytest.mark.parametrize(("name", "small", "large"), [("turn", 0.002, 0.3), ("shift", 0.0005, 0.2)])
def test_twice_a_small_error_counts_four_times_and_twice_a_large_one_twice(
    name: str, small: float, large: float
) -> None:
    loss = {"turn": "rotation", "shift": "joint"}[name]

    def of(amount: float) -> float:
        return float(losses(**{name: amount})[loss])

    assert of(2 * small) / of(small) == pytest.approx(4, rel=0.1)
    assert of(2 * large) / of(large) == pytest.approx(2, rel=0.1)
    assert of(large) == of(-large)

    def beside_reconstruction(amount: float) -> float:
        found = losses(**{name: amount})
        return float(found["total"] - found["reconstruction"])

    assert beside_reconstruction(2 * large) / beside_reconstruction(large) == pytest.approx(2, rel=0.1)


def test_nothing_is_learned_of_a_part_that_the_body_lacks() -> None:
    found = losses(turn=0.5, shift=0.5, present=(1, 0))
    assert found["rotation"] == 0 and found["joint"] == 0


TURN = turned_about(torch.tensor([[0.4, -0.7, 0.2]]))[0]
MISSED = turned_about(torch.tensor([[0.0, 0.3, 0.1]]))[0]
AT_REST = torch.tensor([[[-0.2, -1, -0.5], [1.3, -1, 0.5], [1, 0.9, 0.2], [-1, 1, -0.2]]])
JOINTS = torch.tensor([[[0.0, -0.5, 0.1], [0.1, 0.2, 0.0]]])
STEP = torch.tensor([[0.0, 0, 0], [0.04, -0.02, 0.03]])


def read_twice(
    *, rotations: Tensor, step: Tensor, again: Tensor, joints_again: Tensor
) -> tuple[dict[str, Tensor], Tensor]:
    """Losses and what was read again of a body turned as a whole, whose parts are first read as turned by
    ``rotations`` [2, 3, 3] and its joints as lying off by ``step``; and again as by the others.
    """
    weights = torch.tensor([[[1.0, 0], [1, 0], [0, 1], [0, 1]]])
    mesh, joints = AT_REST @ TURN.T, JOINTS @ TURN.T
    posed = Posed(weights, AT_REST, JOINTS, TURN.expand(1, 2, 3, 3), joints, torch.ones(1, 2))
    first = Reading(1e4 * weights, AT_REST, rotations[None].requires_grad_(), joints + step)
    second = first._replace(rotations=again[None], joints=joints_again)
    network = Knowing((first, first), (second, second))
    total, named = parts_loss(network, source=mesh, target=mesh, truth=mesh, posed=(posed, posed), at_rest=True)
    for each in (total, *named.values()):
        assert each.isfinite()
    assert not network.read_of[1][0].requires_grad, "no gradient reaches the first reading by the second"
    return {**named, "total": total}, network.read_of[1][0]


def boxed_at_rest(points: Tensor) -> Tensor:
    """Points of the body in the box of it at rest."""
    low, high = AT_REST.amin(1, keepdim=True), AT_REST.amax(1, keepdim=True)
    return (points - (low + high) / 2) / ((high - low) / 2).amax()


def test_what_is_read_rightly_is_read_again_at_rest() -> None:
    still = torch.eye(3).expand(2, 3, 3)
    losses, mesh = read_twice(
        rotations=TURN.repeat(2, 1, 1), step=0 * STEP, again=still, joints_again=boxed_at_rest(JOINTS)
    )
    torch.testing.assert_close(mesh - mesh.mean(1), boxed_at_rest(AT_REST) - boxed_at_rest(AT_REST).mean(1))
    assert losses["at_rest"].abs() < 1e-6


def test_of_a_part_that_was_misread_the_rest_is_to_be_read() -> None:
    """Both parts are read as turned a little less far than they are, alike, so that the body stays in one piece."""
    rotations, missing = (TURN @ MISSED).repeat(2, 1, 1), MISSED.T
    again, about = missing.expand(2, 3, 3), JOINTS[:, :1]
    middle, half = box((AT_REST - about) @ missing.T + about)
    joints = ((JOINTS - about) @ missing.T + about - middle) / half
    losses, _ = read_twice(rotations=rotations, step=0 * STEP, again=again, joints_again=joints)
    assert losses["at_rest"].abs() < 1e-5
    wrong, _ = read_twice(rotations=rotations, step=0 * STEP, again=again.mT, joints_again=joints)
    assert wrong["at_rest"] > 0.01 and wrong["rotation"] == losses["rotation"]
    more = {name: (wrong[name] - losses[name]).item() for name in ("total", "at_rest")}
    assert more["total"] == pytest.approx(2 * more["at_rest"], rel=1e-3)


def test_of_a_joint_that_was_misread_the_step_to_it_is_turned_with_the_body() -> None:
    still = torch.eye(3).expand(2, 3, 3)
    found = {"rotations": TURN.repeat(2, 1, 1), "step": STEP, "again": still}
    losses, _ = read_twice(**found, joints_again=boxed_at_rest(JOINTS))
    assert losses["at_rest"].abs() < 1e-6 < losses["joint"]
    as_read, _ = read_twice(**found, joints_again=boxed_at_rest(JOINTS + STEP @ TURN))
    assert as_read["at_rest"] > 0.0005


def test_of_a_joint_between_parts_that_are_turned_apart_half_of_the_step_goes_along_with_each() -> None:
    """As by half of its weight linear blend skinning takes it along with each."""
    bend = turned_about(torch.tensor([[0.9, 0.0, 0.0]]))[0]
    rotations = torch.stack([torch.eye(3), bend])[None]
    step = torch.tensor([0.0, 0.03, 0.05])
    weights = torch.tensor([[[1.0, 0], [1, 0], [0, 1], [0, 1]]])
    mesh = torch.cat([AT_REST[:, :2], (AT_REST[:, 2:] - JOINTS[:, 1:]) @ bend.T + JOINTS[:, 1:]], dim=1)
    posed = Posed(weights, AT_REST, JOINTS, rotations, JOINTS + torch.stack([0 * step, step]), torch.ones(1, 2))
    first = Reading(1e4 * weights, AT_REST, rotations, JOINTS)
    expected = JOINTS + torch.stack([0 * step, (step + bend.T @ step) / 2])
    second = first._replace(rotations=torch.eye(3).expand(1, 2, 3, 3), joints=boxed_at_rest(expected))
    network = Knowing((first, first), (second, second))
    _, named = parts_loss(network, source=mesh, target=mesh, truth=mesh, posed=(posed, posed), at_rest=True)
    assert named["at_rest"].abs() < 1e-6 < named["joint"]


def test_what_is_near_along_the_surfaces_is_told_at_rest_too_and_each_mesh_is_its_own() -> None:
    legs = Parts(joints={"pelvis": None, "head": "pelvis"}, width=8, token_width=8, blocks=1)
    meshes = {"source": AT_REST, "target": AT_REST.flip(1) * 0.5, "truth": AT_REST}
    posed = Posed(
        torch.full((1, 4, 2), 0.5), AT_REST, JOINTS, torch.eye(3).expand(1, 2, 3, 3), JOINTS, torch.ones(1, 2)
    )
    asked = list[tuple[object, ...]]()

    def read_pair(*given: object) -> tuple[Reading, Reading]:
        asked.append(given)
        return Parts.read_pair(legs, *given[:2])  # type: ignore[arg-type]

    legs.read_pair = read_pair  # type: ignore[method-assign]
    surfaces: object = (object(), object())
    parts_loss(legs, **meshes, posed=(posed, posed), surfaces=surfaces, at_rest=True)  # type: ignore[arg-type]
    (first, _), (again, other) = (given[:2] for given in asked)
    assert [given[2] for given in asked] == [surfaces, surfaces]
    assert isinstance(again, Tensor) and isinstance(other, Tensor) and first is AT_REST
    assert not torch.allclose(again, other), "the target is not the source"
