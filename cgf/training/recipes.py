"""The recipes: `contrastive` (ours), `paper` (triplets, as published) and `pca` (the linear baseline)."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from cgf.checks import InputError
from cgf.descriptors.network import Network, NetworkCard, write_network
from cgf.descriptors.settings import ModelDefaults
from cgf.training.augmentation import Augmentation
from cgf.training.batches import Batch, Batches
from cgf.training.distributed import Processes, started
from cgf.training.fragments import Fragments, fragments_of_meshes, fragments_of_scenes, with_other_normals
from cgf.training.loop import LoopSettings, train
from cgf.training.loss import contrastive_loss, quality_loss, triplet_loss
from cgf.training.modules import AzimuthNetwork, FeatureNetwork, PaperNetwork, joined
from cgf.training.settings import TrainSettings
from cgf.training.surroundings import Surroundings
from cgf.training.triplets import TripletBatch, Triplets
from cgf.types import Progress

_JOIN_RATE = 10.0
"""How much faster the layer that joins supports learns than all of a network."""


@dataclass(frozen=True, eq=False)
class _Trained:
    weights: dict[str, np.ndarray]
    steps: int


def run(settings: TrainSettings, *, command: str = "", progress: Progress) -> Network:
    """Train as `settings` say and write weights and card.

    Args:
        settings: What to train on and how.
        command: Kept in the card, so that the weights can be made again.
        progress: Told the share of the current stage that is done.

    Raises:
        InputError: The data cannot be read or holds no overlapping clouds.
    """
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    defaults = settings.lengths
    with started(settings.device) as processes:
        fragments = _fragments(settings, defaults, progress)
        trained = _TRAIN[settings.recipe](settings, defaults, fragments, processes, progress)
    card = replace(
        _card(settings, defaults),
        command=command,
        data=", ".join(path.name for path in ([settings.meshes] if settings.meshes else settings.scenes)),
        seed=settings.seed,
        training={
            "recipe": settings.recipe,
            "steps": trained.steps,
            "batch": settings.batch,
            "clouds": len(fragments.clouds),
            "overlaps": len(fragments.overlaps),
            "torch": torch.__version__,
        },
        # What was left to a default that may change.
        config=settings.config()
        | {
            "steps": trained.steps,
            "support_radius": defaults.support_radius,
            "min_radius": defaults.min_radius,
            "histogram": settings.chosen_histogram,
        },
    )
    network = Network(card, trained.weights)
    if processes.is_first:
        write_network(settings.output, network)
    return network


def _card(settings: TrainSettings, defaults: ModelDefaults) -> NetworkCard:
    """What the network takes and gives, without how it was made."""
    return NetworkCard(
        kind="pca" if settings.recipe == "pca" else settings.chosen_network,
        model=settings.model,
        dims=settings.dims if settings.contrastive else settings.dims[-1:],
        frame=settings.chosen_frame,
        relative=defaults.relative,
        support_radius=defaults.support_radius,
        min_radius=defaults.min_radius,
        lrf_radius=defaults.lrf_radius,
        voxel_sizes=settings.voxel_sizes or (defaults.voxel_size,),
        histogram=settings.chosen_histogram,
        nested=settings.contrastive,
        pooled=settings.contrastive,
        insets=settings.insets,
        context=settings.context,
    )


def _fragments(settings: TrainSettings, defaults: ModelDefaults, progress: Progress) -> Fragments:
    if settings.meshes is not None:
        return fragments_of_meshes(
            settings.meshes,
            defaults=defaults,
            view_sets=settings.view_sets,
            noise=settings.noise,
            seed=settings.seed,
            progress=progress,
        )
    sizes = settings.voxel_sizes or (defaults.voxel_size,)
    return fragments_of_scenes(
        list(settings.scenes), logs=settings.logs, defaults=defaults, voxel_sizes=sizes, progress=progress
    )


def _fingerprint(settings: TrainSettings, fragments: Fragments) -> str:
    """Changes with everything that changes the course of training by more than rounding."""
    apart = {"output", "checkpoint_every", "device"}
    values = {name: str(value) for name, value in asdict(settings).items() if name not in apart}
    values |= {name: str(value) for name, value in asdict(settings.lengths).items()}
    digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode())
    for cloud in fragments.clouds:
        digest.update(cloud.points.tobytes())
    return digest.hexdigest()


def _contrastive(
    settings: TrainSettings, defaults: ModelDefaults, fragments: Fragments, processes: Processes, progress: Progress
) -> _Trained:
    azimuth = settings.chosen_network == "azimuth"
    if settings.normal_radii:
        fragments = with_other_normals(fragments, settings.normal_radii, progress=progress)
    batches = partial(
        Batches,
        fragments,
        support_radius=defaults.support_radius,
        min_radius=defaults.min_radius,
        lrf_radius=defaults.lrf_radius,
        # The azimuth network has to do without a repeatable x axis.
        frame="random" if azimuth else settings.chosen_frame,
        tau=defaults.tau,
        size=settings.batch,
        per_batch=settings.overlaps_per_batch,
        augmentation=Augmentation(
            stretch=settings.stretch,
            bend=settings.bend,
            mirror=settings.mirror,
            holes=settings.holes,
            cut=settings.cut,
        ),
        seed=settings.seed,
        share=processes.share_of(settings.overlaps_per_batch, "--overlaps-per-batch"),
        insets=settings.insets,
        oriented=settings.chosen_histogram == "normals",
        negatives=settings.negatives,
        scenes=settings.scenes_per_batch,
    )

    def loss_of(embed: Callable[..., Tensor], batch: Batch) -> Tensor:
        around = [] if batch.around is None else [torch.from_numpy(batch.around)]
        features = embed(torch.from_numpy(np.concatenate([batch.source, batch.target])), *around)
        source, target = (processes.gather(half) for half in features.chunk(2))
        ignored = torch.from_numpy(batch.ignored).to(features.device)
        loss = contrastive_loss(source, target, ignored, dims=settings.dims, temperature=settings.temperature)
        judged, logits = _judged_dim(settings.dims), torch.cat([source[:, -1], target[:, -1]])
        return loss + quality_loss(logits, source[:, :judged], target[:, :judged], ignored)

    loop = _loop(settings, fragments, steps=6_000, learning_rate=1e-3)
    loop = replace(loop, weight_decay=settings.weight_decay, cosine_decay=True, average=0.998)
    folder = settings.output.with_suffix("")
    optimise = partial(train, loss_of=loss_of, processes=processes, progress=progress)
    network = optimise(_network(settings), draw=batches().draw, settings=loop, folder=folder)
    if len(settings.insets) > 1 or settings.context:
        # Only now: when supports were joined from the start, the network learned the scenes by heart.
        joining = replace(loop, steps=settings.join_steps, learning_rate=_JOIN_RATE * loop.learning_rate)
        join_batches = partial(batches, joined=True)
        if settings.context:
            single = Network(replace(_card(settings, defaults), insets=(0,), context=()), _weights(network))
            surroundings = Surroundings(fragments, single, insets=settings.insets, context=settings.context)
            # What lies around tells scenes apart, which is of no use where one cloud is matched with another.
            join_batches = partial(join_batches, scenes=1, surroundings=surroundings)
        network = joined(network, len(settings.insets), len(settings.context))
        draw = join_batches().draw
        network = optimise(network, draw=draw, settings=joining, folder=folder / "join")
    return _Trained(_weights(network), loop.steps)


def _judged_dim(dims: tuple[int, ...]) -> int:
    """The dimensions in which quality is judged: 32, the default of the descriptor, or what comes nearest."""
    return min(dims, key=lambda dim: abs(dim - 32))


def _paper(
    settings: TrainSettings, defaults: ModelDefaults, fragments: Fragments, processes: Processes, progress: Progress
) -> _Trained:
    share = processes.share_of(settings.batch, "--batch")
    triplets = _triplets(settings, defaults, fragments, share, progress)

    def loss_of(embed: Callable[..., Tensor], batch: TripletBatch) -> Tensor:
        features = embed(torch.from_numpy(batch.histograms))
        anchors, positives, negatives = (features[torch.from_numpy(rows).to(features.device)] for rows in batch.rows)
        return triplet_loss(anchors, positives, negatives)

    loop = _loop(settings, fragments, steps=3 * triplets.batches_per_epoch, learning_rate=1e-4)
    module = train(
        _network(settings),
        draw=triplets.draw,
        loss_of=loss_of,
        settings=loop,
        folder=settings.output.with_suffix(""),
        processes=processes,
        progress=progress,
    )
    return _Trained(_weights(module), loop.steps)


def _network(settings: TrainSettings) -> FeatureNetwork:
    """The network that `settings` ask for, not trained."""
    dim, histogram, judges = settings.dims[-1], settings.chosen_histogram, settings.contrastive
    if settings.chosen_network == "azimuth":
        return AzimuthNetwork(dim, width=settings.width, histogram=histogram, dropout=settings.dropout, judges=judges)
    return PaperNetwork(dim, histogram=histogram, judges=judges)


def _pca(
    settings: TrainSettings, defaults: ModelDefaults, fragments: Fragments, processes: Processes, progress: Progress
) -> _Trained:
    from sklearn.decomposition import IncrementalPCA

    if processes.count > 1:
        raise InputError(f"--recipe pca must run in one process, got {processes.count}; start it without torchrun")
    triplets = _triplets(settings, defaults, fragments, slice(None), progress)
    pca = IncrementalPCA(n_components=settings.dims[-1])
    steps = settings.steps or 40
    for step in range(steps):
        pca.partial_fit(triplets.draw(step).histograms)
        progress((step + 1) / steps, f"principal components, part {step + 1} of {steps}")
    weights = {"mean": pca.mean_, "components": pca.components_}
    return _Trained({name: np.ascontiguousarray(v, np.float32) for name, v in weights.items()}, steps)


def _triplets(
    settings: TrainSettings, defaults: ModelDefaults, fragments: Fragments, share: slice, progress: Progress
) -> Triplets:
    return Triplets(
        fragments,
        support_radius=defaults.support_radius,
        min_radius=defaults.min_radius,
        lrf_radius=defaults.lrf_radius,
        frame=settings.chosen_frame,
        soft=settings.chosen_network == "azimuth" and settings.recipe != "pca",
        tau=defaults.tau,
        batch=settings.batch,
        seed=settings.seed,
        share=share,
        progress=progress,
    )


def _loop(settings: TrainSettings, fragments: Fragments, *, steps: int, learning_rate: float) -> LoopSettings:
    """How to optimise: plain Adam as in the paper, for `steps` and at `learning_rate` if the user has not chosen."""
    return LoopSettings(
        steps=settings.steps or steps,
        learning_rate=settings.learning_rate or learning_rate,
        weight_decay=0.0,
        cosine_decay=False,
        average=0.0,
        low_precision=settings.precision == "bfloat16",
        checkpoint_every=settings.checkpoint_every,
        fingerprint=_fingerprint(settings, fragments),
    )


def _weights(module: nn.Module) -> dict[str, np.ndarray]:
    """Rounded to half precision, in which they are written: more digits than bfloat16 products take."""
    return {name: value.detach().cpu().half().float().numpy() for name, value in module.state_dict().items()}


_TRAIN = {"contrastive": _contrastive, "paper": _paper, "pca": _pca}
