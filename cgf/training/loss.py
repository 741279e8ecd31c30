"""The objectives: the paper's triplet loss, a contrastive loss over nested dimensions, and that of the quality."""

import torch
from torch import Tensor
from torch.nn import functional


def triplet_loss(anchors: Tensor, positives: Tensor, negatives: Tensor) -> Tensor:
    """Mean of [|a - p|^2 - |a - n|^2 + 1]_+ over rows (the paper's equation 4).

    Args:
        anchors: (T, D) features.
        positives: (T, D), known to be similar to the anchors.
        negatives: (T, D), known to be dissimilar.
    """
    near = (anchors - positives).square().sum(dim=1)
    far = (anchors - negatives).square().sum(dim=1)
    return (near - far + 1).clamp_min(0).mean()


def contrastive_loss(
    sources: Tensor, targets: Tensor, ignored: Tensor, *, dims: tuple[int, ...], temperature: float
) -> Tensor:
    """Symmetric cross-entropy of matching row i to row i, averaged over prefixes of the features.

    Nesting follows Kusupati et al., Matryoshka Representation Learning (2022); the loss is that of Oord et al.,
    Contrastive Predictive Coding (2018), in both directions.

    Args:
        sources: (B, D) features; row i corresponds to row i of `targets`.
        targets: (B, D).
        ignored: (B, B) bool; entries that are no negatives, such as neighbours of the true partner.
        dims: Lengths of the prefixes; each is normalised by itself.
        temperature: Divides cosine similarities.
    """
    rows = torch.arange(len(sources), device=sources.device)
    total = sources.new_zeros(())
    for dim in dims:
        a = functional.normalize(sources[:, :dim], dim=1)
        b = functional.normalize(targets[:, :dim], dim=1)
        logits = (a @ b.T / temperature).masked_fill(ignored, float("-inf"))
        total = total + functional.cross_entropy(logits, rows) + functional.cross_entropy(logits.T, rows)
    return total / (2 * len(dims))


def quality_loss(logits: Tensor, sources: Tensor, targets: Tensor, ignored: Tensor) -> Tensor:
    """Cross-entropy of the estimated quality: is the nearest feature of the other side the corresponding one?

    It teaches the estimate alone: no gradient goes to the features.

    Args:
        logits: (2 B,) of the sources, then of the targets.
        sources: (B, D) features; row i corresponds to row i of `targets`.
        targets: (B, D).
        ignored: As for `contrastive_loss`.
    """
    with torch.no_grad():
        a, b = functional.normalize(sources, dim=1), functional.normalize(targets, dim=1)
        similarities = (a @ b.T).masked_fill(ignored, float("-inf"))
        rows = torch.arange(len(sources), device=sources.device)
        right = torch.cat([similarities.argmax(dim=1) == rows, similarities.argmax(dim=0) == rows])
    return functional.binary_cross_entropy_with_logits(logits, right.float())
