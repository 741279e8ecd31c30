"""Training in several processes gives what one gives; the test's processes talk over gloo, on the processor."""

import json
import subprocess
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from cgf import cli  # noqa: E402  After the skip.
from cgf.checks import InputError  # noqa: E402
from cgf.descriptors.network import read_network  # noqa: E402
from cgf.descriptors.settings import MODEL_DEFAULTS  # noqa: E402
from cgf.training import distributed, recipes  # noqa: E402
from cgf.training.augmentation import Augmentation  # noqa: E402
from cgf.training.batches import Batches  # noqa: E402
from cgf.training.distributed import Processes, started  # noqa: E402
from cgf.training.fragments import Fragments, Overlap  # noqa: E402
from cgf.training.loss import triplet_loss  # noqa: E402
from cgf.training.settings import TrainSettings  # noqa: E402
from cgf.training.triplets import Triplets  # noqa: E402
from cgf.types import PointCloud  # noqa: E402
from tests.cloud_files import write_scene  # noqa: E402


def losses(folder):
    return [json.loads(line)["loss"] for line in (folder / "log.jsonl").read_text().splitlines()]


# What `torchrun --nproc-per-node 2` does, but the processes are forked when torch is loaded, which takes seconds.
LAUNCH = """
import sys
import torch._dynamo
from torch.distributed.launcher.api import LaunchConfig, elastic_launch
import cgf.training.recipes
from cgf.cli import main
config = LaunchConfig(
    1, 1, 2, start_method="fork", rdzv_backend="c10d", rdzv_endpoint="localhost:0", run_id="test", max_restarts=0
)
sys.exit(max(elastic_launch(config, main)(sys.argv[1:]).values()))
"""


class Killed(BaseException):
    """As sudden as a signal."""


def test_two_processes_go_on_where_one_was_killed_and_lose_what_it_would_have(tmp_path, monkeypatch):
    scenes = [tmp_path / name for name in ("one", "two")]
    for seed, scene in enumerate(scenes):
        write_scene(scene, seed)

    def command(name):
        options = ["--scenes", *map(str, scenes), "--model", "indoor", "--steps", "6", "--quiet"]
        sizes = "--batch 32 --overlaps-per-batch 4 --width 32 --dims 8 16 --checkpoint-every 2"
        joining = "--insets 0 2 --context 1 4 --join-steps 3"
        return ["train", "-o", str(tmp_path / f"{name}.safetensors"), *options, *sizes.split(), *joining.split()]

    def kill(share, text):
        if text.startswith("step 3 "):
            raise Killed

    assert cli.main(command("alone")) == 0
    monkeypatch.setattr("cgf.cli.train._silent", kill)
    with pytest.raises(Killed):
        cli.main(command("shared"))
    assert not (tmp_path / "shared.safetensors").exists()
    words = [sys.executable, "-c", LAUNCH, *command("shared")]
    ended = subprocess.run(words, check=False, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0, ended.stderr
    # Steps 3 to 6 in single precision; the sums differ by their order alone.
    np.testing.assert_allclose(losses(tmp_path / "shared"), losses(tmp_path / "alone"), rtol=1e-5)
    np.testing.assert_allclose(losses(tmp_path / "shared/join"), losses(tmp_path / "alone/join"), rtol=1e-5)
    assert read_network(tmp_path / "shared.safetensors").card.dims == (8, 16)


def floors():
    """Two clouds of one bumpy floor as a scene, and a second such scene."""
    clouds = []
    for seed in (0, 0, 1, 1):
        x, y = np.random.default_rng(len(clouds)).uniform(0, 2, (2, 1_500))
        points = np.column_stack([x, y, 0.1 * np.sin(5 * x + seed) * np.cos(4 * y)])
        clouds.append(PointCloud(points, np.tile([0.0, 0.0, 1.0], (len(x), 1))))
    overlaps = [Overlap(2 * scene, 2 * scene + 1, np.eye(4), scene, 0.1) for scene in range(2)]
    return Fragments(clouds, overlaps, [clouds[:2], clouds[2:]])


def test_shares_of_a_batch_are_its_parts():
    given = {"support_radius": 0.9, "min_radius": 0.075, "lrf_radius": 0.2, "frame": "random", "tau": 0.1}

    def draw(share):
        batches = Batches(floors(), **given, size=24, per_batch=4, augmentation=Augmentation(), seed=1, share=share)
        return batches.draw(3)

    whole, parts = draw(slice(None)), [draw(slice(0, 2)), draw(slice(2, 4))]
    assert len(parts[0].source) == len(parts[1].source) == 12
    np.testing.assert_array_equal(np.concatenate([part.source for part in parts]), whole.source)
    np.testing.assert_array_equal(np.concatenate([part.target for part in parts]), whole.target)
    for part in parts:
        np.testing.assert_array_equal(part.ignored, whole.ignored)


def test_shares_of_triplets_have_the_mean_loss_of_all():
    def loss(share):
        lengths = {"support_radius": 0.9, "min_radius": 0.075, "lrf_radius": 0.25, "tau": 0.1}
        batch = Triplets(floors(), **lengths, batch=16, seed=1, share=share, progress=lambda *_: None).draw(2)
        rows = torch.from_numpy(batch.histograms)
        return float(triplet_loss(*(rows[chosen] for chosen in batch.rows)))

    assert (loss(slice(0, 8)) + loss(slice(8, 16))) / 2 == pytest.approx(loss(slice(None)))


def processes(count=1):
    return Processes(0, count, torch.device("cpu"))


def test_what_cannot_be_shared_evenly_is_refused(tmp_path):
    assert Processes(2, 4, torch.device("cpu")).share_of(12, "--batch") == slice(6, 9)
    with pytest.raises(InputError, match=r"--batch must be a multiple of the number of processes \(4\), got 6"):
        processes(4).share_of(6, "--batch")


def test_principal_components_are_refused_in_several_processes(tmp_path):
    settings = TrainSettings(output=tmp_path / "a.safetensors", meshes=tmp_path, recipe="pca")
    with pytest.raises(InputError, match="--recipe pca must run in one process, got 2"):
        recipes._pca(settings, MODEL_DEFAULTS["object"], floors(), processes(2), lambda *_: None)


@pytest.mark.parametrize(
    ("device", "count", "message"),
    [
        ("cuda", "1", "--device must be one of cpu, mps, got cuda, which torch does not find here"),
        ("mps", "2", "--device must be one of cpu, got mps, which serves one process alone"),
    ],
)
def test_a_device_that_is_not_there_is_refused(monkeypatch, device, count, message):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setenv("WORLD_SIZE", count)
    with pytest.raises(InputError, match=message), started(device):
        pass


def test_each_process_takes_the_gpu_of_its_number(monkeypatch):
    chosen = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert distributed._device("auto", 2) == torch.device("cuda", 1)
    assert chosen == [1]
    monkeypatch.setenv("LOCAL_RANK", "2")
    with pytest.raises(InputError, match=r"--nproc-per-node must be at most the number of GPUs here \(2\), got 3"):
        distributed._device("cuda", 3)
