"""Training in several processes, one a GPU or machine, as `torchrun` starts them; one process needs nothing of this.

The batch is the same however many processes share it: each embeds its part, and they exchange features, losses and
gradients. `DistributedDataParallel` takes the mean of the gradients; `Processes.gather` is written for that.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from cgf.checks import InputError
from cgf.training.settings import DeviceChoice


@dataclass(frozen=True)
class Processes:
    """Which of the processes this is, and where it computes."""

    rank: int
    """From 0; number 0 alone writes files."""
    count: int
    device: torch.device

    @property
    def is_first(self) -> bool:
        """Whether this process writes the files."""
        return self.rank == 0

    def share_of(self, total: int, name: str) -> slice:
        """This process's part of `total` things, in order of the processes.

        Raises:
            InputError: They cannot be shared evenly; the sentence names the option `name`.
        """
        if total % self.count:
            raise InputError(f"{name} must be a multiple of the number of processes ({self.count}), got {total}")
        each = total // self.count
        return slice(self.rank * each, (self.rank + 1) * each)

    def parallel(self, network: nn.Module) -> nn.Module:
        """The network with gradients that are the mean over all processes, and the weights of the first."""
        if self.count == 1:
            return network
        return DistributedDataParallel(network, device_ids=[self.device] if self.device.type == "cuda" else None)

    def gather(self, rows: Tensor) -> Tensor:
        """The rows of all processes, (count * B, ...), in order of the processes; gradients flow into one's own.

        Every process then computes the same loss of all rows.
        """
        return rows if self.count == 1 else _Gather.apply(rows, self)

    def mean(self, value: Tensor) -> float:
        """Mean of a scalar over all processes."""
        if self.count > 1:
            value = value.detach().clone()
            distributed.all_reduce(value)
            value /= self.count
        return float(value.detach())

    def from_first(self, value: Any) -> Any:
        """What the first process passes, in all."""
        if self.count == 1:
            return value
        values = [value]
        distributed.broadcast_object_list(values, src=0, device=self.device)
        return values[0]


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, rows: Tensor, processes: Processes) -> Tensor:
        context.processes = processes
        parts = [torch.empty_like(rows) for _ in range(processes.count)]
        distributed.all_gather(parts, rows.contiguous())
        return torch.cat(parts)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        # The gradients of all parts belong in a sum, and DistributedDataParallel will take their mean.
        processes, gradient = context.processes, gradients[0]
        each = len(gradient) // processes.count
        return gradient[processes.rank * each : (processes.rank + 1) * each] * processes.count, None


@contextmanager
def started(device: DeviceChoice) -> Iterator[Processes]:
    """Join the other processes that `torchrun` has started, if any, for the length of the block.

    Raises:
        InputError: There is no such device, or not one for each process.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    chosen = _device(device, count)
    if count == 1:
        yield Processes(0, 1, chosen)
        return
    distributed.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield Processes(distributed.get_rank(), count, chosen)
    finally:
        distributed.destroy_process_group()


def _device(choice: DeviceChoice, count: int) -> torch.device:
    """The device of this process: the GPU of its number on its machine, where there are GPUs."""
    has = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available() and count == 1}
    name = next(name for name in ("cuda", "mps", "cpu") if has[name]) if choice == "auto" else choice
    if not has[name]:
        reason = "which serves one process alone" if name == "mps" and count > 1 else "which torch does not find here"
        raise InputError(f"--device must be one of {', '.join(k for k, v in has.items() if v)}, got {name}, {reason}")
    if name != "cuda" or count == 1:
        return torch.device(name)
    place, found = int(os.environ.get("LOCAL_RANK", "0")), torch.cuda.device_count()
    if place >= found:
        raise InputError(f"--nproc-per-node must be at most the number of GPUs here ({found}), got {place + 1} or more")
    torch.cuda.set_device(place)
    return torch.device("cuda", place)
