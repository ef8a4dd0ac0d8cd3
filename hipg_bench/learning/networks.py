"""Actors, the central critic and running normalisation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hipg_bench.errors import BundleError
from hipg_bench.policies.network import CLIP, AttentionSpec, NetworkSpec


class RunningNorm(nn.Module):
    """Running mean and scale of a vector, by Chan's parallel update.

    Columns in ``fixed`` pass through unchanged: health must, since a critic is asked about deaths it
    has hardly seen, and dividing by their tiny deviation would throw its input far off. Each array in
    ``shared`` (slots, entry) names columns that say the same of several slots, and are normalised alike.
    """

    count: Tensor
    mean: Tensor
    square: Tensor
    free: Tensor

    def __init__(self, size: int, fixed: np.ndarray | None = None, shared: Sequence[np.ndarray] = ()) -> None:
        super().__init__()
        self.shared = [torch.as_tensor(columns) for columns in shared]
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
        mean, variance = x.mean(0), x.var(0, unbiased=False)
        for columns in self.shared:
            of_slots = mean[columns]
            variance[columns] = variance[columns].mean(0) + of_slots.var(0, unbiased=False)
            mean[columns] = of_slots.mean(0)
        fresh = mean - self.mean
        total = self.count + len(x)
        self.square += variance * len(x) + fresh**2 * self.count * len(x) / total
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


class AttentionBody(nn.Module):
    """What `hipg_bench.policies.attention.Attention` computes, to be trained: one head, D the first width.

    An agent asks one question, so keys and values of every slot need not be made: the question is taken to
    the embeddings of the slots, and these are mixed before they become a value.
    """

    def __init__(self, spec: AttentionSpec, hidden: tuple[int, ...], action_size: int) -> None:
        super().__init__()
        own, slots = spec.columns()
        size, gain = hidden[0], math.sqrt(2)
        self._own = torch.as_tensor(own)
        self._slots = {group: torch.as_tensor(columns) for group, columns in slots.items()}
        self._present = spec.present_columns()
        self.own = mlp((own.size, size), Tanh, gain)
        self.slot = nn.ModuleDict(
            {group: mlp((at.shape[1], size), Tanh, gain) for group, at in slots.items()}
        )
        self.attention = nn.MultiheadAttention(size, num_heads=1)
        self.head = mlp((2 * size, *hidden[1:], action_size), Tanh, 0.01)
        self._activation = Tanh()

    def forward(self, x: Float[Tensor, "*lead O"]) -> Float[Tensor, "*lead A"]:
        """Mean action; ``x`` is normalised, but for the columns that say whether a slot holds somebody."""
        lead, x = x.shape[:-1], x.flatten(0, -2)
        own = self._activation(self.own(x[:, self._own]))
        embedded = [self.slot[group](x[:, columns]) for group, columns in self._slots.items()]
        answer = self._ask(own, self._activation(torch.cat(embedded, dim=1)), self._there(x))
        return self.head(torch.cat([own, answer], dim=1)).unflatten(0, lead)

    def _there(self, x: Float[Tensor, "X O"]) -> Bool[Tensor, "X slots"]:
        """Which slots hold somebody."""
        there: list[Tensor] = []
        for group, columns in self._slots.items():
            present = self._present[group]
            all_are = torch.ones(len(x), len(columns), dtype=torch.bool)
            there.append(all_are if present is None else x[:, torch.as_tensor(present)] > 0)
        return torch.cat(there, dim=1)

    def _ask(
        self, own: Float[Tensor, "X D"], token: Float[Tensor, "X slots D"], there: Bool[Tensor, "X slots"]
    ) -> Float[Tensor, "X D"]:
        """The attention's answer to the own embedding; zeros where nobody is there."""
        attention, size = self.attention, own.shape[1]
        ask, key, value = attention.in_proj_weight.split(size)
        ask_bias, _, value_bias = attention.in_proj_bias.split(size)  # the keys' adds the same to every fit
        question = nn.functional.linear(own, ask, ask_bias) @ key / math.sqrt(size)
        fit = (question[:, None] * token).sum(-1)
        somebody = there.any(dim=1, keepdim=True)
        share = fit.masked_fill(~there & somebody, -torch.inf).softmax(dim=1)
        mixed = (share[:, :, None] * token).sum(1)
        return attention.out_proj(nn.functional.linear(mixed, value, value_bias)) * somebody

    def weights(self) -> dict[str, Tensor]:
        """Parameters by their names in a policy file."""
        embeddings = {"own": self.own} | dict(self.slot.items())
        out = {
            f"{name}.{path.removeprefix('0.')}": parameter
            for name, module in embeddings.items()
            for path, parameter in module.named_parameters()
        }
        out |= {f"attention.{name}": parameter for name, parameter in self.attention.named_parameters()}
        return out | _stack(self.head)


def _stack(layers: nn.Module) -> dict[str, Tensor]:
    """Parameters of linear layers by their names in a policy file."""
    linears = [layer for layer in layers.children() if isinstance(layer, nn.Linear)]
    return {
        f"layer{k}.{name}": parameter
        for k, layer in enumerate(linears)
        for name, parameter in layer.named_parameters()
    }


class Actor(nn.Module):
    """A Gaussian policy shared by all agents: each acts on its own observation alone.

    Attributes:
        spec: of its mean action's network, which `tensors` are the weights of.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        hidden: tuple[int, ...],
        initial_std: float,
        *,
        spec: NetworkSpec,
        normalize: bool = True,
    ) -> None:
        super().__init__()
        self.spec = spec
        fixed = None if normalize else np.arange(observation_size)
        if isinstance(spec, AttentionSpec):
            present = [columns for columns in spec.present_columns().values() if columns is not None]
            fixed = np.concatenate([np.empty(0, np.int64), *present]) if normalize else fixed
            self.norm = RunningNorm(observation_size, fixed, shared=list(spec.columns()[1].values()))
            self.body = AttentionBody(spec, hidden, action_size)
        else:
            self.norm = RunningNorm(observation_size, fixed)
            self.body = mlp((observation_size, *hidden, action_size), Tanh, 0.01)
        self.log_std = nn.Parameter(torch.full((action_size,), math.log(initial_std)))

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
        for name, parameter in self._weights().items():
            parameter.copy_(given[name])

    def tensors(self) -> dict[str, np.ndarray]:
        """What `hipg_bench.policies.network.save_network` writes: the mean action's network."""
        out = {"observation.mean": self.norm.offset, "observation.scale": self.norm.scale} | self._weights()
        return {name: tensor.detach().numpy().copy() for name, tensor in out.items()}

    def _weights(self) -> dict[str, Tensor]:
        return self.body.weights() if isinstance(self.body, AttentionBody) else _stack(self.body)


class Critic(nn.Module):
    """A value function of F observed numbers and of the elapsed share of the horizon.

    It predicts returns normalised by their running mean and deviation.
    """

    def __init__(
        self,
        size: int,
        hidden: tuple[int, ...],
        health_columns: np.ndarray,
        *,
        normalize: bool = True,
        normalize_returns: bool = True,
        further: int = 0,
    ) -> None:
        """Make a value function; ``further`` numbers of its input come unnormalised, behind `inputs`."""
        super().__init__()
        self.norm = RunningNorm(size, health_columns if normalize else np.arange(size))
        self.returns = RunningNorm(1, None if normalize_returns else np.arange(1))
        self.body = mlp((size + 1 + further, *hidden, 1), nn.ELU, 1.0)

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
