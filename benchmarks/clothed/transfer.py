"""Networks on people in clothes, whose truth is draped: a table by what the target wears, and a picture.

python -m benchmarks.clothed.transfer table DATA FOLDER NAME=WEIGHTS [NAME=WEIGHTS ...] [--triples 100]
python -m benchmarks.clothed.transfer picture DATA FOLDER NAME=WEIGHTS [...] --picture docs/images/clothed-transfer.png

DATA is of the body `mixed`: Anny, then `clothed` (recipe `clothed-transfer-test`). FOLDER keeps what is measured; the
same command again goes on. The picture shows of each outfit the triple of the median PMD of the last network.
"""

import argparse
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from datagen.bodies.clothed.draping import depths
from datagen.bodies.clothed.model import ClothedModel, body_faces
from datagen.bodies.skinning import skin
from datagen.generate import inline
from datagen.mesh.geometry import Mesh, bounding_box
from datagen.mesh.parts import part_colors
from datagen.poses import Poses
from datagen.recipe import ClothedBody, MixedBody
from datagen.store import Dataset, open_dataset
from training.data.batch import read_batch
from training.evaluation.evaluate import Method, Row, evaluate, triples_in
from training.evaluation.measure import SKINNED, Contender, outputs_of
from training.evaluation.tables import COLUMNS, DRESSED_COLUMNS, PARTS, Column, columns_of
from training.recipes.training import EvaluationRecipe
from training.viz.mesh_grid import Panel, mesh_grid, standing
from training.viz.mesh_grid import Row as Drawn
from workflows.pretrained import weights_named

_EMD_POINTS = 512
_DEEP_METRES = 0.002
_BARE, _TRUTH = "bare", "the truth"
_SHOWN = ("pmd", "chamfer", "earth_mover", "millimetres", "edge_ratio", "normal_degrees")


class People:
    """The people of a dataset, and what they wear; ``about``: which triples are measured, how."""

    def __init__(self, dataset: Dataset, about: EvaluationRecipe) -> None:
        self.dataset, self.about = dataset, about
        mixed = dataset.recipe.body
        assert isinstance(mixed, MixedBody), mixed
        recipe = mixed.bodies[1]
        assert isinstance(recipe, ClothedBody), recipe
        self.outfits = recipe.outfits
        self._model = ClothedModel(recipe)

    def worn(self, identity: int) -> str:
        """The name of an identity's outfit."""
        return _BARE if self.dataset.part(identity) is None else self.outfits[int(self._own(identity)[-2])]

    def mesh(self, identity: int, pose: int) -> Mesh:
        """An identity in a pose as it is stored, metres."""
        return Mesh(self.dataset.vertices(identity, pose).astype(np.float64), self.dataset.faces(identity))

    def share_within(self, mesh: Mesh, identity: int, pose: int) -> float:
        """Of the vertices of an identity's garments, the share deeper than 2 mm in its whole body in the true pose."""
        attributes, part = self.dataset.attributes, self.dataset.part(identity)
        assert part is not None, identity
        poses = Poses(tuple(attributes["joints"]), tuple(attributes["joint_parents"]), self.dataset.rotations()[[pose]])
        person = self._model.person(tuple(self._own(identity)))
        body = skin(person.body, self._model.world_rotations(poses))[0]
        return float(np.mean(depths(mesh.vertices[part > 0].astype(np.float32), body, body_faces()) > _DEEP_METRES))

    def _own(self, identity: int) -> list[float]:
        names, values = self.dataset.attributes["body"]["parameters"], self.dataset.parameters(identity)
        return [float(value) for name, value in zip(names, values, strict=True) if name.startswith("1.clothed.")]


def measured(people: People, folder: Path, methods: Sequence[Method]) -> list[Row]:
    """Rows of all methods and controls."""

    def told(chunks: Iterable[list[Row]], total: int, done: int) -> Iterator[list[Row]]:
        for rows in chunks:
            done += triples_in(rows)
            print(f"{done} of {total} triples", flush=True)
            yield rows

    return evaluate(methods, people.dataset.url, people.about, tasks=inline, keep=folder, progress=told)


def outputs(people: People, methods: Sequence[Method], triples: NDArray[np.integer]) -> dict[str, list[Mesh]]:
    """What each method makes of some triples, where the truths stand, and the truths."""
    batch = read_batch(people.dataset, triples, padded=True, surfaces=True)
    truths = [people.mesh(identity, pose) for _, pose, identity, _ in triples.tolist()]
    made = {_TRUTH: truths}
    for contender in [*(Contender(its.name, its.weights) for its in methods), Contender(SKINNED, "")]:
        found = outputs_of(contender, batch, people.dataset, triples).double().numpy()
        made[contender.name] = [
            Mesh(bounding_box(truth.vertices).restore(each[: len(truth.vertices)]), truth.faces)
            for each, truth in zip(found, truths, strict=True)
        ]
    return made


def shares_within(people: People, methods: Sequence[Method], rows: Sequence[Row]) -> dict[tuple[str, int], float]:
    """Of each method and triple onto a dressed target, the share of its garments that lies within the body."""
    triples = {row.triple: row for row in rows if people.worn(row.target_identity) != _BARE}
    found = dict[tuple[str, int], float]()
    for number, row in sorted(triples.items()):
        target, pose = row.target_identity, row.source_pose
        made = outputs(people, methods, np.array([(row.source_identity, pose, target, row.target_pose)]))
        found |= {(name, number): people.share_within(meshes[0], target, pose) for name, meshes in made.items()}
    return found


def table(people: People, methods: Sequence[Method], rows: Sequence[Row]) -> None:
    """One line for each outfit and method, as Markdown."""
    within = shares_within(people, methods, rows)
    columns = [column for column in COLUMNS if column.field in _SHOWN]
    headings = ["PMD x1e-4", "from bare", "from dressed", "median", *(its.heading for its in columns[1:])]
    headings += [*(its.heading for its in DRESSED_COLUMNS), "in body"]
    print("| target | method |", " | ".join(headings), "|")
    print("|---|---|", "---:|" * len(headings), sep="")
    for outfit in (_BARE, *people.outfits):
        its = [row for row in rows if people.worn(row.target_identity) == outfit]
        for method in dict.fromkeys(row.method for row in its):
            ours = [row for row in its if row.method == method]
            shares = [within[method, row.triple] for row in ours if (method, row.triple) in within]
            cells = [*_cells(people, ours, columns), f"{np.mean(shares):.1%}" if shares else ""]
            print(f"| `{outfit}` | {method} |", " | ".join(cells), "|")
        shares = [
            within[_TRUTH, number] for number in sorted({row.triple for row in its}) if (_TRUTH, number) in within
        ]
        if shares:
            print(
                f"| `{outfit}` | {_TRUTH} |", " | ".join([*[""] * (len(headings) - 1), f"{np.mean(shares):.1%}"]), "|"
            )


def table_by_part(people: People, rows: Sequence[Row]) -> None:
    """One line for each outfit, part and method, as Markdown."""
    print("| target | part | method |", " | ".join(its.heading for its in columns_of(PARTS[0])), "|")
    print("|---|---|---|", "---:|" * len(columns_of(PARTS[0])), sep="")
    for outfit in people.outfits:
        its = [row for row in rows if people.worn(row.target_identity) == outfit]
        for part in PARTS:
            for method in dict.fromkeys(row.method for row in its):
                if (part, method) == (PARTS[0], SKINNED):  # it moves skin exactly
                    continue
                ours = [row for row in its if row.method == method]
                cells = [_mean(ours, column) for column in columns_of(part)]
                print(f"| `{outfit}` | {part} | {method} |", " | ".join(cells), "|")


def _cells(people: People, rows: Sequence[Row], columns: Sequence[Column]) -> list[str]:
    pmd, *others = columns
    bare = [row for row in rows if people.worn(row.source_identity) == _BARE]
    dressed = [row for row in rows if people.worn(row.source_identity) != _BARE]
    cells = [_mean(some, pmd) for some in (rows, bare, dressed)]
    cells.append(f"{np.median([row.pmd for row in rows]) * pmd.factor:.{pmd.decimals}f}")
    is_dressed = people.worn(rows[0].target_identity) != _BARE
    cells += [_mean(rows, its) for its in others]
    return cells + [_mean(rows, its) if is_dressed else "" for its in DRESSED_COLUMNS]


def _mean(rows: Sequence[Row], column: Column) -> str:
    values = [getattr(row, column.field) for row in rows]
    return f"{np.mean(values) * column.factor:.{column.decimals}f}" if values else ""


def picture(people: People, methods: Sequence[Method], rows: Sequence[Row], path: Path) -> None:
    """Of each outfit the triple of the last network's median PMD: source, target, outputs, truth."""
    drawn = []
    for outfit in people.outfits:
        its = [row for row in rows if people.worn(row.target_identity) == outfit and row.method == methods[-1].name]
        row = sorted(its, key=lambda each: each.pmd)[len(its) // 2]
        triple = row.source_identity, row.source_pose, row.target_identity, row.target_pose
        made = outputs(people, methods, np.array([triple]))
        number = row.pose_type, row.triple
        errors = {other.method: other for other in rows if (other.pose_type, other.triple) == number}
        given = triple[:2], triple[2:]
        panels = [_panel(people, people.mesh(*who_and_pose), who_and_pose[0]) for who_and_pose in given]
        for name in (*(method.name for method in methods), SKINNED):
            words = f"skin {errors[name].skin_millimetres:.0f}, garments {errors[name].garment_millimetres:.0f} mm"
            panels.append(_panel(people, made[name][0], triple[2], words))
        panels.append(_panel(people, made[_TRUTH][0], triple[2]))
        drawn.append(Drawn(outfit, panels))
    columns = ["source", "target", *(method.name for method in methods), SKINNED, _TRUTH]
    title = "A source's pose on people in clothes; of each outfit a triple of median error"
    mesh_grid(drawn, path, columns=columns, title=title, one_scale=False, size=(250, 230))
    Image.open(path).convert("RGB").quantize(200).save(path, optimize=True)


def _panel(people: People, mesh: Mesh, identity: int, words: str = "") -> Panel:
    part = people.dataset.part(identity)
    labels = np.zeros(len(mesh.vertices), np.int32) if part is None else part
    return Panel(Mesh(standing(mesh.vertices), mesh.faces), part_colors(labels) / 255, words)


def _method(word: str) -> Method:
    name, equals, weights = word.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{word!r} is not of the form NAME=WEIGHTS")
    return Method(name, str(weights_named(weights)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["table", "picture"])
    parser.add_argument("data")
    parser.add_argument("folder", type=Path)
    parser.add_argument("methods", nargs="+", type=_method, metavar="NAME=WEIGHTS")
    parser.add_argument("--picture", type=Path, default=Path("docs/images/clothed-transfer.png"))
    parser.add_argument("--triples", type=int, help="the first so many alone")
    given = parser.parse_args()
    its_about = EvaluationRecipe(emd_points=_EMD_POINTS, triples=given.triples)
    its_people = People(open_dataset(given.data), its_about)
    its_rows = measured(its_people, given.folder, given.methods)
    if given.what == "table":
        table(its_people, given.methods, its_rows)
        print()
        table_by_part(its_people, its_rows)
    else:
        picture(its_people, given.methods, its_rows, given.picture)
