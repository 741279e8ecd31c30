"""The training loop: batches, optimiser, checkpoints that resume to the bit."""

import json
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from cgf.checks import InputError
from cgf.training.distributed import Processes
from cgf.types import Progress

BatchT = TypeVar("BatchT")
NetworkT = TypeVar("NetworkT", bound=nn.Module)


@dataclass(frozen=True)
class LoopSettings:
    """How a network is optimised, whatever the loss."""

    steps: int
    learning_rate: float
    weight_decay: float
    cosine_decay: bool
    """Warm up over the first 2 % of the steps, then fall to zero as a half cosine; else constant."""
    average: float
    """Decay of the exponential moving average of the weights that is exported; 0 exports the last weights."""
    low_precision: bool
    """Forward and backward in bfloat16; quick where the processor has AMX, slow elsewhere."""
    checkpoint_every: int
    fingerprint: str
    """Of data and settings; a checkpoint of another one is refused."""


def train(
    network: NetworkT,
    *,
    draw: Callable[[int], BatchT],
    loss_of: Callable[[Callable[..., Tensor], BatchT], Tensor],
    settings: LoopSettings,
    folder: Path,
    processes: Processes,
    progress: Progress,
) -> NetworkT:
    """Optimise `network` and return the module to export; `loss_of` is given the network and a batch.

    Batch `step` is `draw(step)` and depends on nothing else, so a run killed at any moment continues from its last
    checkpoint exactly as if it had not been; `log.jsonl` in `folder` keeps the losses. Of several processes, each is
    given its own part of the batch, and the first writes the files.

    Raises:
        InputError: The checkpoint in `folder` belongs to other settings.
        FloatingPointError: The loss is no longer finite.
    """
    network.to(processes.device)
    averaged = torch.optim.swa_utils.AveragedModel(network, multi_avg_fn=_moving_average(settings.average))
    optimizer = torch.optim.AdamW(
        network.parameters(), lr=settings.learning_rate, betas=(0.9, 0.999), weight_decay=settings.weight_decay
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _rate(step, settings))
    parts: dict[str, Any] = {"network": network, "averaged": averaged, "optimizer": optimizer, "schedule": schedule}
    first = _resume(folder / "checkpoint.pt", parts, settings, processes)
    if processes.is_first:
        folder.mkdir(parents=True, exist_ok=True)
        _truncate_log(folder / "log.jsonl", first)
    parallel = processes.parallel(network)

    def embed(*inputs: Tensor) -> Tensor:
        with torch.autocast(processes.device.type, dtype=torch.bfloat16, enabled=settings.low_precision):
            features: Tensor = parallel(*(values.to(processes.device) for values in inputs))
        return features.float()

    log_path = folder / "log.jsonl" if processes.is_first else Path(os.devnull)
    with ThreadPoolExecutor(1) as pool, log_path.open("a") as log:
        coming = pool.submit(draw, first)
        for step in range(first, settings.steps):
            batch = coming.result()
            coming = pool.submit(draw, min(step + 1, settings.steps - 1))
            # For dropout: a run that was cut off goes on as if it had not been.
            torch.manual_seed(step)
            loss = loss_of(embed, batch)
            value = processes.mean(loss)
            if not value == value or abs(value) == float("inf"):
                raise FloatingPointError(f"the loss is {value} at step {step}; lower --learning-rate and start again")
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]  # untyped in torch
            optimizer.step()
            schedule.step()
            averaged.update_parameters(network)
            log.write(json.dumps({"step": step, "loss": value}) + "\n")
            progress((step + 1) / settings.steps, f"step {step + 1} of {settings.steps}, loss {value:.3f}")
            due = (step + 1) % settings.checkpoint_every == 0 or step + 1 == settings.steps
            if due and processes.is_first:
                log.flush()
                _save(folder / "checkpoint.pt", parts, step + 1, settings)
    if settings.average <= 0:
        return network
    assert isinstance(averaged.module, type(network))
    return averaged.module


def _rate(step: int, settings: LoopSettings) -> float:
    """Factor on the learning rate."""
    if not settings.cosine_decay:
        return 1.0
    warm = max(settings.steps // 50, 1)
    if step < warm:
        return (step + 1) / warm
    share = (step - warm) / max(settings.steps - warm, 1)
    return float(0.5 * (1 + torch.cos(torch.tensor(share * torch.pi))))


def _moving_average(decay: float) -> Callable[[Any, Any, Any], None]:
    """Exponential moving average that trusts early weights less, so that short runs are not dominated by the start."""

    def update(averages: list[Tensor], values: list[Tensor], count: Tensor) -> None:
        rate = max(1 - decay, 1 / (float(count) + 1))
        for average, value in zip(averages, values, strict=True):
            average.lerp_(value, rate)

    return update


def _save(path: Path, parts: dict[str, Any], step: int, settings: LoopSettings) -> None:
    """Write a checkpoint so that a kill at any moment leaves either the old one or the new one."""
    partial = path.with_suffix(".partial")
    states = {name: part.state_dict() for name, part in parts.items()}
    torch.save({"step": step, "fingerprint": settings.fingerprint, **states}, partial)
    partial.replace(path)


def _resume(path: Path, parts: dict[str, Any], settings: LoopSettings, processes: Processes) -> int:
    """Load the first process's checkpoint, if there is one, and return the step to go on with."""
    state = None
    if processes.is_first and path.is_file():
        state = torch.load(path, weights_only=True, map_location="cpu")
    state = processes.from_first(state)
    if state is None:
        return 0
    if state["fingerprint"] != settings.fingerprint:
        raise InputError(
            f"{path} belongs to a run with other settings or data; give another --output, or remove that folder"
        )
    for name, part in parts.items():
        part.load_state_dict(state[name])
    return int(state["step"])


def _truncate_log(path: Path, steps: int) -> None:
    """Drop losses of steps that come again."""
    if path.is_file():
        lines = path.read_text().splitlines(keepends=True)[:steps]
        path.write_text("".join(lines))
