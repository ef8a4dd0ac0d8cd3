"""A gated recurrent unit: each agent remembers what it alone has seen."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench.errors import BundleError
from hipg_bench.policies.network_spec import (
    WIDEST,
    NetworkSpec,
    Shapes,
    Tensors,
    check_head,
    check_observation,
    check_shape,
    check_stack,
    forward,
    layers,
    normalise,
    quantize,
    stack_names,
)


class GRUSpec(NetworkSpec):
    """As an MLP's."""

    format: ClassVar[str] = "hipg-gru-1"


class GRU:
    """A decentralised policy with a memory per agent, laid out as ``torch.nn.GRU`` with one layer.

    The observation passes the layers ``encoder<k>`` (perhaps none), each followed by the activation, then the
    unit, then the layers ``layer<k>`` to the action.

    Attributes:
        privileged: it acts on observations.
        spec: what its file declares.
        observation_size, action_size, hidden_size: O, A and H, the numbers that an agent remembers.
    """

    privileged = False

    def __init__(self, tensors: Tensors, spec: GRUSpec) -> None:
        """Take float64 tensors, already checked."""
        self.spec, self._tensors = spec, tensors
        self._encoder, self._layers = layers(tensors, "encoder"), layers(tensors, "layer")
        self.observation_size = tensors["observation.mean"].size
        self.hidden_size = tensors["gru.weight_hh"].shape[1]
        self.action_size = self._layers[-1][1].size // max(spec.bins, 1)

    @staticmethod
    def check(shapes: Shapes, spec: GRUSpec) -> set[str]:
        """Return the names of the tensors it is made of.

        Raises:
            BundleError: shapes that do not chain from the observation to the action.
        """
        width = check_stack(shapes, "encoder", check_observation(shapes))
        back = shapes.get("gru.weight_hh", ())
        hidden = back[-1] if len(back) == 2 else 0
        if not 0 < hidden <= WIDEST:
            raise BundleError(f"gru.weight_hh is {back}; expected (3 H, H)")
        unit = {
            "gru.weight_ih": (3 * hidden, width),
            "gru.weight_hh": (3 * hidden, hidden),
            "gru.bias_ih": (3 * hidden,),
            "gru.bias_hh": (3 * hidden,),
        }
        for name, shape in unit.items():
            check_shape(shapes, name, shape)
        if "layer0.weight" not in shapes:
            raise BundleError("layer0, from the memory to the action, is missing")
        check_head(spec, check_stack(shapes, "layer", hidden))
        stacks = stack_names(shapes, "encoder") | stack_names(shapes, "layer")
        return {"observation.mean", "observation.scale", *unit} | stacks

    def initial_state(
        self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int
    ) -> Float[np.ndarray, "B N H"]:
        """Nothing seen yet."""
        return np.zeros((len(episode_id), num_agents, self.hidden_size))

    def act(
        self,
        observation: Float[np.ndarray, "B N O"],
        memory: Float[np.ndarray, "B N H"],
        alive: Bool[np.ndarray, "B N"],
    ) -> tuple[Float[np.ndarray, "B N A"], Float[np.ndarray, "B N H"]]:
        """The best action, without exploration noise; in [-reach, reach]."""
        seen = normalise(self._tensors, observation)
        if self._encoder:
            seen = self.spec.activate(forward(self._encoder, seen, self.spec))
        after = quantize(self._remember(seen, memory))
        return self.spec.action(forward(self._layers, after, self.spec)), after

    def _remember(
        self, seen: Float[np.ndarray, "B N I"], memory: Float[np.ndarray, "B N H"]
    ) -> Float[np.ndarray, "B N H"]:
        """One step of the unit; torch orders the gates reset, update, new."""
        own = self._tensors
        ahead = np.split(seen @ own["gru.weight_ih"].T + own["gru.bias_ih"], 3, axis=-1)
        back = np.split(memory @ own["gru.weight_hh"].T + own["gru.bias_hh"], 3, axis=-1)
        reset, update = _sigmoid(ahead[0] + back[0]), _sigmoid(ahead[1] + back[1])
        fresh = np.tanh(ahead[2] + reset * back[2])
        return (1.0 - update) * fresh + update * memory


def _sigmoid(x: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    return 0.5 + 0.5 * np.tanh(0.5 * x)  # never overflows
