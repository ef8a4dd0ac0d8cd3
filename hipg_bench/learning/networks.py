"""The actor, the central critic and running normalisation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from hipg_bench.errors import BundleError
from hipg_bench.policies.network import CLIP


class RunningNorm(nn.Module):
    """Running mean and scale of a vector, by Chan's parallel update.

    Columns in ``fixed`` pass through unchanged: health must, since a critic is asked about deaths it
    has hardly seen, and dividing by their tiny deviation would throw its input far off.
    """

    count: Tensor
    mean: Tensor
    square: Tensor
    free: Tensor

    def __init__(self, size: int, fixed: np.ndarray | None = None) -> None:
        super().__init__()
        free = torch.ones(size, dtype=torch.bool)
        if fixed is not None:
            free[torch.as_tensor(fixed)] = False
        self.register_buffer("free", free)
        self.register_buffer("count", torch.tensor(1e-4, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("square", torch.full((size,), 1e-4, dtype=torch.float64))

    @torch.no_grad()
    def update(self, x: Float[Tensor, "X size"]) -> None:
        """Take in a batch, perhaps an empty one."""
        if len(x) == 0:
            return
        x = x.double()
        fresh = x.mean(0) - self.mean
        total = self.count + len(x)
        self.square += x.var(0, unbiased=False) * len(x) + fresh**2 * self.count * len(x) / total
        self.mean += fresh * len(x) / total
        self.count.copy_(total)

    @torch.no_grad()
    def adopt(self, offset: Float[Tensor, "size"], scale: Float[Tensor, "size"], count: int) -> None:
        """Start as if ``count`` samples of this mean and scale had been taken in."""
        self.mean.copy_(offset)
        self.square.copy_(scale.double() ** 2 * count)
        self.count.fill_(float(count))

    @property
    def offset(self) -> Float[Tensor, "size"]:
        """What is subtracted."""
        return torch.where(self.free, self.mean, 0.0).float()

    @property
    def scale(self) -> Float[Tensor, "size"]:
        """What is divided by."""
        return torch.where(self.free, (self.square / self.count).sqrt().clamp(min=1e-2), 1.0).float()

    def forward(self, x: Float[Tensor, "... size"]) -> Float[Tensor, "... size"]:
        """Normalise, cut to +-CLIP."""
        return ((x - self.offset) / self.scale).clamp(-CLIP, CLIP)


class Tanh(nn.Module):
    """The same function as torch's own, which takes ten times as long on a CPU."""

    def forward(self, x: Float[Tensor, "... size"]) -> Float[Tensor, "... size"]:
        """Hyperbolic tangent."""
        return 2 * torch.sigmoid(2 * x) - 1


def mlp(sizes: tuple[int, ...], activation: type[nn.Module], last_gain: float) -> nn.Sequential:
    """Linear layers with orthogonal weights; no activation after the last."""
    layers: list[nn.Module] = []
    for k, (width, wider) in enumerate(itertools.pairwise(sizes)):
        last = k == len(sizes) - 2
        linear = nn.Linear(width, wider)
        nn.init.orthogonal_(linear.weight, last_gain if last else math.sqrt(2))
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, activation()]
    return nn.Sequential(*layers)


class Actor(nn.Module):
    """A Gaussian policy shared by all agents: each acts on its own observation alone."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden: tuple[int, ...],
        std: float,
        *,
        normalize: bool = True,
    ) -> None:
        super().__init__()
        self.norm = RunningNorm(observation_size, None if normalize else np.arange(observation_size))
        self.body = mlp((observation_size, *hidden, action_size), Tanh, 0.01)
        self.log_std = nn.Parameter(torch.full((action_size,), math.log(std)))

    def forward(self, observation: Float[Tensor, "... O"]) -> torch.distributions.Normal:
        """Distribution of each action coordinate."""
        return self.distribution(self.norm(observation))

    def distribution(self, normalized: Float[Tensor, "... O"]) -> torch.distributions.Normal:
        """The same of observations that are normalised already."""
        return torch.distributions.Normal(self.body(normalized), self.log_std.exp(), validate_args=False)

    @torch.no_grad()
    def adopt(self, tensors: Mapping[str, np.ndarray], count: int) -> None:
        """Take the weights that `tensors` once wrote; exploration's deviation stays as it is.

        Args:
            tensors: of a network with the same layers.
            count: samples that the adopted normalisation weighs, beside what is met from now on.

        Raises:
            BundleError: its layers are others.
        """
        own = {name: tensor.shape for name, tensor in self.tensors().items()}
        theirs = {name: tensor.shape for name, tensor in tensors.items()}
        if own != theirs:
            raise BundleError(f"a start must have tensors {own}, got {theirs}")
        given = {name: torch.from_numpy(tensor) for name, tensor in tensors.items()}
        self.norm.adopt(given["observation.mean"], given["observation.scale"], count)
        linears = [layer for layer in self.body if isinstance(layer, nn.Linear)]
        for k, layer in enumerate(linears):
            layer.weight.copy_(given[f"layer{k}.weight"])
            layer.bias.copy_(given[f"layer{k}.bias"])

    def tensors(self) -> dict[str, np.ndarray]:
        """What `hipg_bench.policies.network.save_network` writes: the mean action's network."""
        linears = [layer for layer in self.body if isinstance(layer, nn.Linear)]
        out = {"observation.mean": self.norm.offset, "observation.scale": self.norm.scale}
        for k, layer in enumerate(linears):
            out |= {f"layer{k}.weight": layer.weight, f"layer{k}.bias": layer.bias}
        return {name: tensor.detach().numpy().copy() for name, tensor in out.items()}


class Critic(nn.Module):
    """A value function of what it is shown and of the share of the horizon that has passed.

    It is shown the joint state, or each agent's observation (the arm ``local``), F numbers either
    way, and predicts returns normalised by their running mean and deviation.
    """

    def __init__(
        self,
        size: int,
        hidden: tuple[int, ...],
        health_columns: np.ndarray,
        *,
        normalize: bool = True,
        normalize_returns: bool = True,
    ) -> None:
        super().__init__()
        self.norm = RunningNorm(size, health_columns if normalize else np.arange(size))
        self.returns = RunningNorm(1, None if normalize_returns else np.arange(1))
        self.body = mlp((size + 1, *hidden, 1), nn.ELU, 1.0)

    def inputs(self, seen: Float[Tensor, "... F"], elapsed: Float[Tensor, "..."]) -> Float[Tensor, "... I"]:
        """What the network itself is fed, I = F + 1 numbers."""
        return torch.cat([self.norm(seen), elapsed[..., None]], dim=-1)

    def normalized(self, inputs: Float[Tensor, "... I"]) -> Float[Tensor, "..."]:
        """Value in units of the running deviation of returns."""
        return self.body(inputs)[..., 0]

    def forward(self, seen: Float[Tensor, "... F"], elapsed: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """Value in units of reward."""
        value = self.normalized(self.inputs(seen, elapsed))
        return value * self.returns.scale + self.returns.offset
