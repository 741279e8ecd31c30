"""Training on a few small clouds: the recipes run, resume to the bit and write what the descriptor reads."""

import json
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from cgf.checks import InputError  # noqa: E402  After the skip.
from cgf.descriptors.network import read_network  # noqa: E402
from cgf.descriptors.settings import MODEL_DEFAULTS  # noqa: E402
from cgf.training import recipes  # noqa: E402
from cgf.training.augmentation import Augmentation  # noqa: E402
from cgf.training.batches import Batches  # noqa: E402
from cgf.training.fragments import Fragments, Overlap, fragments_of_meshes, with_other_normals  # noqa: E402
from cgf.training.loss import contrastive_loss, quality_loss, triplet_loss  # noqa: E402
from cgf.training.overlap import overlapping_pairs  # noqa: E402
from cgf.training.recipes import run  # noqa: E402
from cgf.training.render import view_directions  # noqa: E402
from cgf.training.settings import TrainSettings  # noqa: E402
from cgf.training.triplets import HARD_PER_POINT, PER_POINT, Triplets  # noqa: E402
from cgf.types import PointCloud  # noqa: E402
from tests.histograms import random_histograms  # noqa: E402


def silent(share, text):
    assert 0 <= share <= 1
    assert text


def bumpy_mesh(path, count=40):
    """A torus with bumps, as OBJ."""
    u, v = np.meshgrid(*[np.arange(count) / count * 2 * np.pi] * 2, indexing="ij")
    tube = 0.4 + 0.08 * np.sin(3 * u) + 0.05 * np.cos(5 * v + u)
    points = np.stack(
        [(1 + tube * np.cos(v)) * np.cos(u), (1 + tube * np.cos(v)) * np.sin(u), tube * np.sin(v)], axis=-1
    )
    number = lambda i, j: (i % count) * count + j % count + 1  # noqa: E731  Reads like the index it is.
    lines = [f"v {x} {y} {z}" for x, y, z in points.reshape(-1, 3)]
    for i in range(count):
        for j in range(count):
            lines.append(f"f {number(i, j)} {number(i + 1, j)} {number(i + 1, j + 1)}")
            lines.append(f"f {number(i, j)} {number(i + 1, j + 1)} {number(i, j + 1)}")
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    bumpy_mesh(folder / "torus.obj")
    return folder


@pytest.fixture(scope="module")
def fragments(meshes):
    return fragments_of_meshes(
        meshes, defaults=MODEL_DEFAULTS["object"], view_sets=1, noise=(0.0, 0.002), seed=1, progress=silent
    )


def test_views_are_spread_over_the_sphere():
    directions = view_directions()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    np.testing.assert_allclose(directions.sum(axis=0), 0, atol=1e-12)
    assert (directions @ directions.T - 2 * np.eye(14)).max() < 0.6


def test_range_images_lie_on_the_mesh_and_face_the_camera(fragments):
    assert len(fragments.clouds) == 14
    for cloud in fragments.clouds:
        assert 2_000 < len(cloud) < 30_000
        toward = cloud.viewpoint - cloud.points
        assert np.mean(np.einsum("ij,ij->i", cloud.normals, toward) > 0) > 0.99
        assert np.linalg.norm(cloud.points, axis=1).max() < 0.53


def test_only_views_that_overlap_by_30_percent_are_paired(fragments):
    clouds = fragments.clouds[:6]
    from scipy.spatial import cKDTree

    spacings = [np.median(cKDTree(c.points).query(c.points, k=2)[0][:, 1]) for c in clouds]
    expected = []
    for i in range(6):
        for j in range(i + 1, 6):
            shares = [
                np.mean(cKDTree(clouds[b].points).query(clouds[a].points)[0] <= max(spacings))
                for a, b in ((i, j), (j, i))
            ]
            if min(shares) >= 0.3:
                expected.append((i, j))
    assert overlapping_pairs(clouds) == expected


def test_triplet_loss_is_the_formula():
    rng = np.random.default_rng(0)
    a, p, n = (rng.normal(size=(30, 4)) for _ in range(3))
    expected = np.maximum(((a - p) ** 2).sum(1) - ((a - n) ** 2).sum(1) + 1, 0).mean()
    assert float(triplet_loss(*map(torch.from_numpy, (a, p, n)))) == pytest.approx(expected)


def test_contrastive_loss_does_not_see_what_is_ignored():
    rng = np.random.default_rng(0)
    source, target = (torch.from_numpy(rng.normal(size=(6, 8))) for _ in range(2))
    ignored = torch.zeros(6, 6, dtype=torch.bool)
    ignored[0, 1] = True
    arguments = {"dims": (4, 8), "temperature": 0.1}
    full = float(contrastive_loss(source, target, torch.zeros_like(ignored), **arguments))
    assert float(contrastive_loss(source, target, ignored, **arguments)) < full
    # By hand, for one width and nothing ignored.
    a, b = (x / x.norm(dim=1, keepdim=True) for x in (source, target))
    logits = a @ b.T / 0.1
    by_hand = -(logits.log_softmax(1).diag().mean() + logits.log_softmax(0).diag().mean()) / 2
    found = contrastive_loss(source, target, torch.zeros_like(ignored), dims=(8,), temperature=0.1)
    assert float(found) == pytest.approx(float(by_hand))


def test_quality_is_taught_which_features_find_their_partner():
    sources = torch.eye(3)
    targets = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]], requires_grad=True)
    ignored = torch.zeros(3, 3, dtype=torch.bool)
    certain = torch.tensor([9.0, -9, -9, 9, -9, -9], requires_grad=True)
    loss = quality_loss(certain, sources, targets, ignored)
    assert loss < 1e-3
    assert quality_loss(-certain, sources, targets, ignored) > 8
    loss.backward()
    assert certain.grad is not None
    assert targets.grad is None


@pytest.mark.parametrize(
    ("frame", "joined", "oriented"),
    [
        ("random", False, True),
        ("random", True, True),
        ("random", True, False),
        ("normal", False, False),
        ("paper", False, False),
    ],
)
def test_batches_depend_on_their_number_alone(fragments, frame, joined, oriented):
    def make():
        return Batches(
            fragments,
            support_radius=0.17,
            min_radius=0.015,
            lrf_radius=0.02,
            frame=frame,
            tau=0.01,
            size=64,
            per_batch=4,
            augmentation=Augmentation(stretch=0.2, mirror=0.5, holes=0.5, cut=0.5),
            seed=3,
            insets=(0, 2),
            oriented=oriented,
            joined=joined,
        )

    first, second = make(), make()
    first.draw(0)
    batch, again = first.draw(5), second.draw(5)
    np.testing.assert_array_equal(batch.source, again.source)
    np.testing.assert_array_equal(batch.target, again.target)
    size = 8976 if oriented else 2244
    assert batch.source.shape == ((64, 2, size) if joined else (64, size))
    assert not np.diag(batch.ignored).any()
    # Four overlaps of the one scene: what is not within a block is ignored.
    assert batch.ignored[:16, 16:].all()
    assert not batch.ignored[:16, :16].all()


def test_normals_estimated_anew_keep_their_side_and_are_drawn_in_turn(fragments):
    varied = with_other_normals(fragments, (2.0, 5.0), progress=silent)
    for cloud, others in zip(fragments.clouds, varied.other_normals, strict=True):
        assert len(others) == 2
        for normals in others:
            assert (np.einsum("ij,ij->i", normals, cloud.normals) >= 0).all()
            np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
        assert np.abs(others[0] - others[1]).max() > 0.1

    batches = Batches(
        varied, support_radius=0.17, min_radius=0.015, lrf_radius=0.02, frame="random", tau=0.01, size=64,
        per_batch=16, augmentation=Augmentation(), seed=3, oriented=True,
    )  # fmt: skip
    rng = np.random.default_rng(0)
    estimates = [fragments.clouds[1].normals, *varied.other_normals[1]]
    chosen_ones = [batches._normals(1, rng) for _ in range(30)]
    drawn = [next(i for i, normals in enumerate(estimates) if normals is chosen) for chosen in chosen_ones]
    assert set(drawn) == {0, 1, 2}


def plane_pair(tau):
    """Two planes, the second shifted by a third of tau, and the overlap between them."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(0, 1, (3000, 2)), 0.02 * rng.normal(size=3000)])
    normals = np.tile([0.0, 0.0, 1.0], (3000, 1))
    clouds = [PointCloud(points, normals), PointCloud(points + np.array([tau / 3, 0, 0]), normals)]
    return Fragments(clouds, [Overlap(0, 1, np.eye(4), 0, 0.02)], [clouds])


def test_triplets_are_as_the_paper_says():
    tau = 0.05
    data = plane_pair(tau)
    triplets = Triplets(
        data, support_radius=0.3, min_radius=0.03, lrf_radius=0.1, tau=tau, batch=512, seed=1, progress=silent
    )
    assert triplets.batches_per_epoch == 6000 * PER_POINT // 512
    views = triplets._views
    position = lambda cloud, entry: views[cloud].cloud.points[views[cloud].rows[entry]]  # noqa: E731  Reads like a name.
    hard, distances = 0, []
    for number in range(40 * 50):
        anchor, positive, negative = (position(*point) for point in triplets._triplet(number))
        assert np.linalg.norm(anchor - positive) <= tau
        away = np.linalg.norm(anchor - negative)
        distances.append(away)
        if number % PER_POINT < HARD_PER_POINT:
            assert tau < away <= 2 * tau
            hard += 1
    assert hard == 15 * 50
    assert np.median(distances) > 2 * tau


def test_an_epoch_holds_every_triplet_once_in_random_order():
    triplets = Triplets(
        plane_pair(0.05),
        support_radius=0.3,
        min_radius=0.03,
        lrf_radius=0.1,
        tau=0.05,
        batch=512,
        seed=1,
        progress=silent,
    )
    triplets.draw(0)
    order = triplets._order[1]
    assert np.array_equal(np.sort(order), np.arange(6000 * PER_POINT))
    assert not np.array_equal(order[:1000], np.arange(1000))
    batch = triplets.draw(1)
    assert all(len(rows) == 512 for rows in batch.rows)
    assert batch.histograms.shape[1] == 2244


def settings_for(meshes, output, **changes):
    values = {
        "meshes": meshes,
        "output": output,
        "batch": 32,
        "overlaps_per_batch": 4,
        "steps": 6,
        "view_sets": 1,
        "checkpoint_every": 2,
        "dims": (8, 16),
    }
    return TrainSettings(**(values | changes))


class Killed(BaseException):
    """As sudden as a signal."""


@pytest.mark.parametrize(
    ("changes", "last"),
    [
        ({"recipe": "contrastive", "dropout": 0.5}, "step 5 of 6"),
        ({"recipe": "paper"}, "step 5 of 6"),
        ({"insets": (0, 3), "context": (1.0, 3.0), "join_steps": 7}, "step 5 of 7"),
    ],
)
def test_a_killed_run_resumes_to_the_bit(meshes, fragments, tmp_path, monkeypatch, changes, last):
    # With a context, all points of every cloud are described: a few clouds are enough.
    few = replace(fragments, overlaps=[o for o in fragments.overlaps if max(o.source, o.target) < 4])
    assert few.overlaps
    monkeypatch.setattr(recipes, "fragments_of_meshes", lambda *_, **__: few)
    whole = run(settings_for(meshes, tmp_path / "whole.safetensors", **changes), progress=silent)

    def kill(share, text):
        if text.startswith(last):
            raise Killed

    broken = settings_for(meshes, tmp_path / "broken.safetensors", **changes)
    with pytest.raises(Killed):
        run(broken, progress=kill)
    assert not broken.output.exists()
    resumed = run(broken, progress=silent)
    assert whole.weights.keys() == resumed.weights.keys()
    for name, values in whole.weights.items():
        np.testing.assert_array_equal(values, resumed.weights[name])
    logs = [(tmp_path / name / "log.jsonl").read_text() for name in ("whole", "broken")]
    assert logs[0] == logs[1]
    assert [json.loads(line)["step"] for line in logs[0].splitlines()] == list(range(6))


def test_joining_supports_changes_nothing_but_how_they_are_joined(meshes, fragments, tmp_path, monkeypatch):
    monkeypatch.setattr(recipes, "fragments_of_meshes", lambda *_, **__: fragments)
    outputs = {steps: tmp_path / f"{steps}.safetensors" for steps in (1, 6)}
    weights = [
        run(settings_for(meshes, output, insets=(0, 3), join_steps=steps), progress=silent).weights
        for steps, output in outputs.items()
    ]
    changed = {name for name in weights[0] if (weights[0][name] != weights[1][name]).any()}
    assert "join.weight" in changed
    assert all(name.startswith(("join.", "quality.")) for name in changed)
    card = read_network(outputs[6]).card
    assert card.insets == (0, 3)
    assert card.config["insets"] == [0, 3]


@pytest.mark.parametrize(
    ("changes", "kind", "histogram", "nested"),
    [
        ({"recipe": "paper"}, "paper", "counts", False),
        ({"recipe": "paper", "frame": "normal", "histogram": "roots"}, "paper", "roots", False),
        ({"recipe": "paper", "network": "azimuth"}, "azimuth", "roots", False),
        ({"network": "paper"}, "paper", "roots", True),
        ({"histogram": "roots"}, "azimuth", "roots", True),
        ({}, "azimuth", "normals", True),
    ],
)
def test_cards_say_which_steps_from_the_paper_to_ours_were_taken(
    meshes, fragments, tmp_path, monkeypatch, changes, kind, histogram, nested
):
    monkeypatch.setattr(recipes, "fragments_of_meshes", lambda *_, **__: fragments)
    network = run(settings_for(meshes, tmp_path / "a.safetensors", **{"steps": 1, **changes}), progress=silent)
    card = read_network(tmp_path / "a.safetensors").card
    assert (card.kind, card.histogram, card.nested) == (kind, histogram, nested)
    assert card.frame == changes.get("frame", "normal" if nested else "paper")
    assert network.judges == nested
    lengths = np.linalg.norm(network.embed(random_histograms(1, histogram)), axis=1)
    assert (abs(lengths - 1) < 1e-5).all() == nested


def test_a_checkpoint_of_other_settings_is_refused(meshes, fragments, tmp_path, monkeypatch):
    monkeypatch.setattr(recipes, "fragments_of_meshes", lambda *_, **__: fragments)
    run(settings_for(meshes, tmp_path / "a.safetensors", steps=2), progress=silent)
    with pytest.raises(InputError, match="belongs to a run with other settings or data"):
        run(settings_for(meshes, tmp_path / "a.safetensors", steps=2, seed=5), progress=silent)


def test_training_lowers_the_loss(meshes, fragments, tmp_path, monkeypatch):
    monkeypatch.setattr(recipes, "fragments_of_meshes", lambda *_, **__: fragments)
    run(settings_for(meshes, tmp_path / "a.safetensors", steps=40, batch=64), progress=silent)
    losses = [json.loads(line)["loss"] for line in (tmp_path / "a" / "log.jsonl").read_text().splitlines()]
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])


def test_pca_gives_orthogonal_components(meshes, fragments, tmp_path, monkeypatch):
    monkeypatch.setattr(recipes, "fragments_of_meshes", lambda *_, **__: fragments)
    output = tmp_path / "pca.safetensors"
    run(settings_for(meshes, output, recipe="pca", steps=2), progress=silent)
    network = read_network(output)
    assert network.card.kind == "pca"
    np.testing.assert_allclose(network.weights["components"] @ network.weights["components"].T, np.eye(16), atol=1e-4)


def test_a_folder_without_meshes_is_refused(tmp_path):
    with pytest.raises(InputError, match="--meshes must be a folder of meshes"):
        run(settings_for(tmp_path, tmp_path / "a.safetensors"), progress=silent)
