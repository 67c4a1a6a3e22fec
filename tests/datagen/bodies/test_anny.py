"""Anny: its shape space, how identities are drawn, and its cache (its rigs: test_anny_rigs.py)."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import ks_2samp

from datagen.bodies import load_body
from datagen.bodies.anny.model import AnnyModel, _alone_with_whole_files
from datagen.bodies.anny.shape import variation_shares
from datagen.common.errors import BodyError
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses
from datagen.recipe import AnnyBody, AnnyTopology, PhenotypeRanges, PoseRecipe
from tests.support.shapes.bodies import identity

ALL_AGES = PhenotypeRanges(age=(0.0, 1.0))
POSES = draw_poses(PoseRecipe(), range(12))
T_POSE = Poses(JOINTS, PARENTS, np.zeros((1, len(JOINTS), 3)))


def body(topology: AnnyTopology = "notoes_collapse3pc", **options: Any) -> AnnyModel:
    model = load_body(AnnyBody(topology=topology, **options))
    assert isinstance(model, AnnyModel)
    return model


def drawn(model: AnnyModel, count: int) -> dict[str, np.ndarray]:
    parameters = np.stack([identity(model, number) for number in range(count)])
    return dict(zip(model.parameter_names, parameters.T, strict=True))


def annys_own(**options: Any) -> Any:
    import anny

    return anny.Anny(skinning_method="lbs", phenotype_blendshapes="original", **options)


def one(value: float) -> torch.Tensor:
    return torch.tensor([value], dtype=torch.float64)


class TestShape:
    def test_phenotypes_share_themselves_out_as_annys_do(self) -> None:
        """Shares of each phenotype's variations against Anny's own interpolation, corners and middles alike."""
        from anny.models.phenotype import make_phenotype_anchors, phenotype_blendshape_weights

        labels = ["gender", "age", "muscle", "weight", "height", "proportions"]
        count = len(variation_shares({}))
        random = np.random.default_rng(0)
        for values in [np.zeros(6), np.ones(6), np.full(6, 0.5), *random.uniform(size=(20, 6))]:
            theirs = phenotype_blendshape_weights(
                torch.from_numpy(values)[None],
                labels,
                make_phenotype_anchors(torch.float64),
                torch.eye(count, dtype=torch.float64),
                extrapolate=False,
            )
            ours = variation_shares(dict(zip(labels, values.tolist(), strict=True)))
            assert np.abs(ours - theirs[0].numpy()).max() < 1e-12

    def test_vertices_equal_annys_own_forward_pass(self) -> None:
        """Rest shape with local changes, weights and skinning, against Anny's, with every bone turned."""
        model = body(phenotypes=ALL_AGES, local_changes=0.5)
        parameters = identity(model, 5)
        theirs = annys_own(rig="mixamo", topology="notoes_collapse3pc", local_changes="default")
        bones, up = model.bones, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        world = model.world_rotations(POSES)
        parent = np.where(np.array(bones.parents)[None, :, None, None] < 0, np.eye(3), world[:, bones.parents])
        deltas = np.tile(np.eye(4), (len(POSES), len(bones.parents), 1, 1))
        deltas[:, bones.order, :3, :3] = up.T @ (parent.transpose(0, 1, 3, 2) @ world) @ up
        named = {name: one(value) for name, value in zip(model.parameter_names, parameters, strict=True)}
        expected = theirs(
            pose_parameters=torch.from_numpy(deltas),
            phenotype_kwargs={name: value for name, value in named.items() if not name.startswith("local.")},
            local_changes_kwargs={name[6:]: value for name, value in named.items() if name.startswith("local.")},
        )["vertices"].numpy()
        difference = expected @ up.T - model.vertices(parameters, POSES)
        difference -= difference.mean(axis=1, keepdims=True)  # Anny puts the root at the origin, we leave it in place
        assert np.abs(difference).max() < 5e-6

    def test_the_same_bytes_on_one_and_two_torch_threads(self) -> None:
        made, before = [], torch.get_num_threads()
        try:
            for threads in (1, 2):
                torch.set_num_threads(threads)
                model = AnnyModel(AnnyBody(topology="notoes_collapse3pc", ages="population", local_changes=0.3))
                made.append([model.vertices(identity(model, number), POSES).tobytes() for number in range(3)])
        finally:
            torch.set_num_threads(before)
        assert made[0] == made[1]

    def test_the_default_body_stays_as_it_was(self) -> None:
        """Some vertices of identity 0 in pose 0 of the default recipe, as first published, in metres."""
        model = load_body(AnnyBody())
        expected = [
            [-0.034056, 0.743856, 0.130760],
            [-0.698821, 0.236359, 0.171865],
            [-0.225438, -0.515189, -0.018923],
            [0.654992, 0.829885, -0.078288],
            [0.320893, -0.691064, 0.304906],
        ]
        parameters = identity(model)
        found = model.vertices(parameters, POSES[:1])[0, [0, 150, 300, 450, 614]]
        assert found == pytest.approx(np.array(expected), abs=2e-6)

    def test_a_body_that_is_not_finite_is_refused(self) -> None:
        with pytest.raises(BodyError, match="non-finite"):
            body().vertices(np.full(6, np.nan), T_POSE)


class TestIdentities:
    def test_uniform_ages_fill_their_ranges(self) -> None:
        columns = drawn(body(phenotypes=PhenotypeRanges(age=(0.7, 0.8), weight=(0.1, 0.1))), 100)
        assert columns["age"].min() >= 0.7 and columns["age"].max() <= 0.8 and np.ptp(columns["age"]) > 0.09
        assert (columns["weight"] == 0.1).all() and np.ptp(columns["gender"]) > 0.9

    @pytest.mark.parametrize(
        "ranges",
        [
            ALL_AGES,
            PhenotypeRanges(age=(0.95, 1.0), weight=(0.3, 0.3), muscle=(0.999, 1.0)),
            PhenotypeRanges(age=(0.05, 0.05), gender=(1.0, 1.0), height=(0.9, 1.0), weight=(0.0, 0.1)),
        ],
    )
    def test_a_population_stays_within_the_ranges(self, ranges: PhenotypeRanges) -> None:
        columns = drawn(body(ages="population", phenotypes=ranges), 100)
        for name, values in columns.items():
            low, high = getattr(ranges, name)
            assert np.isfinite(values).all() and values.min() >= low and values.max() <= high, name

    def test_a_population_follows_annys_calibrated_distribution(self) -> None:
        """Against two thousand samples of Anny's own sampler: no phenotype's distribution differs."""
        from anny.shape_distribution import SimpleShapeDistribution

        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(1)
            _, theirs = SimpleShapeDistribution(annys_own(rig="mixamo", topology="notoes_collapse3pc")).sample(2000)
        ours = drawn(body(ages="population", phenotypes=ALL_AGES), 2000)
        for name, values in ours.items():
            assert ks_2samp(values, theirs[name].numpy()).pvalue > 1e-3, name
        grown = ours["age"] > 0.67
        assert ks_2samp(ours["height"][grown], theirs["height"].numpy()[theirs["age"].numpy() > 0.67]).pvalue > 1e-3

    def test_a_population_is_plausible(self) -> None:
        """Heights at rest in metres: babies and small children, children, adults, as on growth charts."""
        model = body(ages="population", phenotypes=ALL_AGES)
        people = [identity(model, number) for number in range(150)]
        heights = np.array([np.ptp(model.vertices(person, T_POSE)[0, :, 1]) for person in people])
        ages = np.array(people)[:, model.parameter_names.index("age")]
        bands = ((-0.01, 0.05), (0.05, 0.215), (0.215, 0.415), (0.415, 1.0))  # to 1, 4, 11 and 90 years
        for (young, old), limits in zip(bands, ((0.45, 0.85), (0.65, 1.15), (0.85, 1.55), (1.25, 2.05)), strict=True):
            found = heights[(ages > young) & (ages <= old)]
            assert len(found) and limits[0] < found.min() and found.max() < limits[1], old
        assert heights[ages > 0.67].mean() == pytest.approx(1.69, abs=0.05)

    @pytest.mark.parametrize("ages", ["ranges", "population"])
    def test_draws_neither_use_nor_disturb_torchs_generator(self, ages: str) -> None:
        found = []
        for seed in (1, 2):
            with torch.random.fork_rng(devices=[]):
                torch.default_generator.manual_seed(seed)
                before = torch.get_rng_state()
                model = AnnyModel(AnnyBody(topology="notoes_collapse3pc", ages=ages, local_changes=0.2))
                found.append(identity(model, 7))
                assert torch.equal(before, torch.get_rng_state())
        assert np.array_equal(found[0], found[1]) and not np.array_equal(found[0], identity(model, 8))


class TestLocalChanges:
    def test_none_is_as_it_was(self) -> None:
        assert body(local_changes=0.0).parameter_names == ("gender", "age", "muscle", "weight", "height", "proportions")

    def test_they_follow_the_phenotypes_and_are_named(self) -> None:
        plain, changed = body(), body(local_changes=0.4)
        assert changed.parameter_names[:6] == plain.parameter_names and len(changed.parameter_names) == 260
        assert "local.nose-hump-incr" in changed.parameter_names
        assert np.array_equal(identity(changed, 3)[:6], identity(plain, 3))

    def test_they_are_uniform_within_their_strength_and_alike_left_and_right(self) -> None:
        columns = drawn(body(local_changes=0.4), 60)
        values = np.concatenate([column for name, column in columns.items() if name.startswith("local.")])
        assert np.abs(values).max() <= 0.4 and values.min() < -0.39 and values.max() > 0.39
        assert abs(values.mean()) < 0.01
        assert np.array_equal(columns["local.l-ear-lobe-incr"], columns["local.r-ear-lobe-incr"])
        assert not np.array_equal(columns["local.l-ear-lobe-incr"], columns["local.l-ear-flap-incr"])

    def test_a_rig_has_the_joints_of_the_whole_body_to_the_bit(self) -> None:
        """Bone heads are added up without the vertices there."""
        model = body(local_changes=0.4)
        rig, rest = model.rig(identity(model, 3), JOINTS), model.rest(identity(model, 3))
        bones = [model.bones.labels.index(name) for name in rig.names]
        assert np.array_equal(rig.joints, rest.joints[bones].astype(np.float32))

    def test_zero_values_change_nothing_and_others_do(self) -> None:
        plain, changed = body(), body(local_changes=0.4)
        parameters = identity(changed, 3)
        expected = plain.vertices(parameters[:6], POSES)
        assert np.array_equal(changed.vertices(np.concatenate([parameters[:6], np.zeros(254)]), POSES), expected)
        moved = np.abs(changed.vertices(parameters, POSES) - expected).max(axis=-1)
        assert moved.max() > 0.01 and moved.mean() < 0.1


class TestCache:
    def load(self, monkeypatch: pytest.MonkeyPatch, cache: Path, failure: Exception | None = None) -> AnnyModel:
        import anny
        import anny.paths

        def fail(**_: Any) -> Any:
            raise failure if failure else AssertionError

        monkeypatch.setattr(anny.paths, "_ANNY_CACHE_DIR", [cache])
        if failure:
            monkeypatch.setattr(anny, "Anny", fail)
        return AnnyModel(AnnyBody(topology="soma", rig="cmu_mb"))

    def test_what_anny_cannot_load_is_one_clear_error(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        with pytest.raises(BodyError) as caught:
            self.load(monkeypatch, tmp_path, ValueError("no such mesh"))
        assert all(part in str(caught.value) for part in ("'soma'", "'cmu_mb'", "no such mesh", f"rm -r '{tmp_path}'"))

    def test_a_cache_that_cannot_be_made_is_one_clear_error(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        (tmp_path / "file").write_bytes(b"")
        with pytest.raises(BodyError, match="file/anny"):
            self.load(monkeypatch, tmp_path / "file" / "anny")

    def test_a_build_that_never_ended_is_not_trusted(self, tmp_path: Path) -> None:
        """What it left is removed, older files stay; a build that ended leaves its files and no mark."""
        old, new = tmp_path / "old.safetensors", tmp_path / "v1" / "new.safetensors"
        new.parent.mkdir()
        old.write_bytes(b"x")
        os.utime(old, (1.0, 1.0))
        with pytest.raises(RuntimeError), _alone_with_whole_files(tmp_path):
            new.write_bytes(b"half")
            raise RuntimeError
        with _alone_with_whole_files(tmp_path):
            assert old.exists() and not new.exists()
            new.write_bytes(b"whole")
        with _alone_with_whole_files(tmp_path):
            assert new.exists()

    @pytest.mark.slow
    def test_caches_built_on_one_and_two_threads_hold_the_same_body(self, tmp_path: Path) -> None:
        script = (
            "import sys, torch; torch.set_num_threads(int(sys.argv[1]))\n"
            "from datagen.bodies.anny.model import AnnyModel\n"
            "from datagen.recipe import AnnyBody\n"
            "points = AnnyModel(AnnyBody(topology='notoes_collapse3pc'))._shape.points((.3, .6, .2, .7, .4, .9))\n"
            "import hashlib; print(hashlib.sha256(points.tobytes()).hexdigest())\n"
        )
        hashes = set()
        for threads in ("1", "2"):
            environment = os.environ | {"ANNY_CACHE_DIR": str(tmp_path / threads), "OMP_NUM_THREADS": threads}
            ended = subprocess.run(
                [sys.executable, "-c", script, threads], env=environment, check=True, capture_output=True, text=True
            )
            hashes.add(ended.stdout.splitlines()[-1])
        assert len(hashes) == 1
