"""What the parts network learns from: large errors count as they are, small ones as their squares."""

import pytest
import torch
from torch import Tensor

from training.networks.layers.rigid_parts import turned_about
from training.networks.parts import Parts, Reading
from training.objectives.parts import Posed, parts_loss


class Knowing(Parts):
    """Reads what it is told to."""

    def __init__(self, source: Reading, target: Reading) -> None:
        super().__init__(joints={"pelvis": None, "head": "pelvis"}, width=8, token_width=8, blocks=1)
        self.readings = source, target

    def read_pair(self, *_: object) -> tuple[Reading, Reading]:
        return self.readings


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
        Knowing(read, right), source=VERTICES, target=VERTICES, truth=VERTICES, posed=(posed, posed)
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
