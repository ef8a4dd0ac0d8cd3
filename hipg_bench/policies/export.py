"""From networks of torch and Stable-Baselines3 to policy files: ``<task>/seed<k>.safetensors``.

>>> from hipg_bench.policies.export import export_sequential
>>> export_sequential(actor, "my_agent/hazard_nav-4/seed0.safetensors")

The network must map one agent's observation (O numbers) to that agent's action (A numbers, the mean of what
it would draw), and is shared by all agents.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from torch import nn

from hipg_bench.errors import BundleError
from hipg_bench.policies.network import CLIP, GRUSpec, NetworkSpec, save_network

_IDLE = (nn.Flatten, nn.Identity, nn.Dropout)
"""Layers that change nothing when an agent acts."""
_ACTIVATIONS: dict[str, Literal["tanh", "relu"]] = {"Tanh": "tanh", "ReLU": "relu"}


@runtime_checkable
class Normaliser(Protocol):
    """Running statistics of observations, as Gymnasium's and Stable-Baselines3's ``obs_rms``."""

    mean: Any
    var: Any


def export_sequential(
    actor: nn.Module, path: str | Path, normaliser: Normaliser | None = None, epsilon: float = 1e-8
) -> None:
    """Write a torch network of linear layers.

    Args:
        actor: an ``nn.Sequential`` of ``Linear`` with ``Tanh`` or ``ReLU`` between; a last ``Tanh`` squashes
            the action, else it is cut to [-1, 1].
        path: where to write; a folder named after the task, and ``seed<k>.safetensors``.
        normaliser: what normalised the observations in training, if anything did: the ``obs_rms`` of
            ``NormalizeObservation`` or ``VecNormalize``. Normalised observations are cut to +-10.
        epsilon: added to the variance.

    Raises:
        BundleError: the network has other layers.
    """
    tensors, spec = _stack(actor, "layer")
    _save(tensors, spec, path, tensors["layer0.weight"].shape[1], normaliser, epsilon)


def export_recurrent(
    encoder: nn.Module | None,
    unit: nn.GRU | nn.GRUCell,
    actor: nn.Module,
    path: str | Path,
    normaliser: Normaliser | None = None,
    epsilon: float = 1e-8,
) -> None:
    """Write a torch network with a memory: ``actor(unit(encoder(observation)))``.

    Args:
        encoder: an ``nn.Sequential`` of ``Linear`` layers, each followed by its activation; None for none.
        unit: one layer, one direction; its memory starts as zeros.
        actor: as for `export_sequential`.
        path: where to write.
        normaliser: as for `export_sequential`.
        epsilon: added to the variance.

    Raises:
        BundleError: layers or a unit of another kind.
    """
    tensors, spec = _stack(actor, "layer")
    if encoder is not None:
        encoded, other = _stack(encoder, "encoder", ends_activated=True)
        if "layer1.weight" in tensors and other.activation != spec.activation:
            raise BundleError(f"one activation is allowed, got {other.activation} and {spec.activation}")
        tensors |= encoded
        spec = spec.model_copy(update={"activation": other.activation})
    own = {name.removesuffix("_l0"): tensor for name, tensor in unit.named_parameters()}
    if set(own) != {"weight_ih", "weight_hh", "bias_ih", "bias_hh"}:
        raise BundleError(f"one layer in one direction with biases is allowed, got {sorted(own)}")
    tensors |= {f"gru.{name}": _array(tensor) for name, tensor in own.items()}
    first = "encoder0.weight" if encoder is not None else "gru.weight_ih"
    made = GRUSpec(**spec.model_dump())
    _save(tensors, made, path, tensors[first].shape[1], normaliser, epsilon)


def export_sb3(model: Any, path: str | Path) -> None:
    """Write a policy of Stable-Baselines3: PPO, A2C, SAC, TD3 or DDPG with ``MlpPolicy``.

    It was trained over `hipg_bench.adapters.sb3.HipgVecEnv`, perhaps in a ``VecNormalize``, whose statistics
    are written too.

    Raises:
        BundleError: its network is of another kind, or ``VecNormalize`` cuts observations elsewhere than
            at 10.
    """
    policy = model.policy
    if hasattr(policy, "mlp_extractor"):  # PPO, A2C: the mean of a Gaussian, cut to the action space
        layers = [*policy.mlp_extractor.policy_net, policy.action_net]
    elif hasattr(policy.actor, "latent_pi"):  # SAC: a squashed Gaussian
        layers = [*policy.actor.latent_pi, policy.actor.mu, nn.Tanh()]
    else:  # TD3, DDPG: ends in Tanh
        layers = [*policy.actor.mu]
    worlds = model.get_vec_normalize_env()
    if worlds is None or not worlds.norm_obs:
        export_sequential(nn.Sequential(*layers), path)
        return
    if worlds.clip_obs != CLIP:
        raise BundleError(f"VecNormalize(clip_obs={CLIP:g}) is allowed, got {worlds.clip_obs:g}")
    export_sequential(nn.Sequential(*layers), path, worlds.obs_rms, worlds.epsilon)


def _stack(
    module: nn.Module, name: str, *, ends_activated: bool = False
) -> tuple[dict[str, np.ndarray], NetworkSpec]:
    """The tensors ``<name><k>`` and the spec of linear layers with activations between."""
    leaves = [one for one in _leaves(module) if not isinstance(one, _IDLE)]
    linear: list[nn.Linear] = [one for one in leaves[::2] if isinstance(one, nn.Linear)]
    between: list[str | None] = [type(one).__name__ for one in leaves[1::2]]
    last = between.pop() if len(leaves) % 2 == 0 and between else None
    if ends_activated:
        between, last = [*between, last], None
    kinds = {_ACTIVATIONS.get(str(kind)) for kind in between}
    if len(linear) != len(leaves[::2]) or None in kinds or len(kinds) > 1 or last not in (None, "Tanh"):
        raise BundleError(
            "Linear layers with Tanh or with ReLU between are allowed, and perhaps a last Tanh, got "
            f"{', '.join(type(one).__name__ for one in leaves)}; export other networks as ONNX (tier 1)"
        )
    tensors: dict[str, np.ndarray] = {}
    for k, one in enumerate(linear):
        tensors[f"{name}{k}.weight"] = _array(one.weight)
        tensors[f"{name}{k}.bias"] = _array(one.state_dict().get("bias", torch.zeros(one.out_features)))
    head = "tanh" if last else "mean"
    return tensors, NetworkSpec(activation="relu", head=head) if kinds == {"relu"} else NetworkSpec(head=head)


def _leaves(module: nn.Module) -> list[nn.Module]:
    """The layers in order, one that is used twice twice."""
    if not isinstance(module, nn.Sequential):
        return [module]
    return [leaf for one in module for leaf in _leaves(one)]


def _save(
    tensors: dict[str, np.ndarray],
    spec: NetworkSpec,
    path: str | Path,
    size: int,
    normaliser: Normaliser | None,
    epsilon: float,
) -> None:
    """Write the file with the normaliser's mean and scale."""
    mean, scale = np.zeros(size), np.ones(size)
    if normaliser is not None:
        mean = np.asarray(normaliser.mean, np.float64)
        scale = np.sqrt(np.asarray(normaliser.var, np.float64) + epsilon)
        if mean.shape != (size,) or scale.shape != (size,):
            raise BundleError(f"the normaliser is of {mean.shape}, the network takes in ({size},)")
    save_network(tensors | {"observation.mean": mean, "observation.scale": scale}, Path(path), spec)


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()
