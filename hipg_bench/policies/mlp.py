"""A multilayer perceptron: the action from what an agent sees now."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench.errors import BundleError
from hipg_bench.policies.network_spec import (
    NetworkSpec,
    Shapes,
    Tensors,
    check_head,
    check_observation,
    check_stack,
    forward,
    layers,
    normalise,
    stack_names,
)


class MLP:
    """A decentralised policy: each agent's action from its own observation alone.

    Attributes:
        privileged: it acts on observations.
        spec: what its file declares.
        observation_size, action_size: O and A.
        num_agents: N where every agent has weights of its own, None where all share theirs.
    """

    privileged = False

    def __init__(self, tensors: Tensors, spec: NetworkSpec) -> None:
        """Take float64 tensors, already checked."""
        self.spec, self._tensors = spec, tensors
        self._layers = layers(tensors, "layer")
        last = self._layers[-1][1]
        self.num_agents = len(last) if last.ndim == 2 else None
        if self.num_agents is not None:
            self._layers = [(weight, bias[:, None]) for weight, bias in self._layers]
        self.observation_size = tensors["observation.mean"].size
        self.action_size = last.shape[-1] // max(spec.bins, 1)

    @staticmethod
    def check(shapes: Shapes, spec: NetworkSpec) -> set[str]:
        """Return the names of the tensors it is made of.

        Raises:
            BundleError: shapes that do not chain from the observation to the action.
        """
        lead = shapes.get("layer0.bias", ())[:-1]  # (N,) where every agent has weights of its own, or ()
        if len(lead) > 1 or "layer0.weight" not in shapes:
            found = shapes.get("layer0.weight"), shapes.get("layer0.bias")
            raise BundleError(f"layer0 is {found[0]}, {found[1]}; expected (out, O), (out,)")
        check_head(spec, check_stack(shapes, "layer", check_observation(shapes), lead))
        return {"observation.mean", "observation.scale"} | stack_names(shapes, "layer")

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> None:
        """Remember nothing.

        Raises:
            BundleError: every agent has weights of its own, and they are not this many.
        """
        if self.num_agents not in (None, num_agents):
            raise BundleError(f"the network has weights for {self.num_agents} agents, the task {num_agents}")

    def act(
        self, observation: Float[np.ndarray, "B N O"], memory: None, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], None]:
        """The best action, without exploration noise; in [-reach, reach]."""
        hidden = normalise(self._tensors, observation)
        if self.num_agents is None:
            return self.spec.action(forward(self._layers, hidden, self.spec)), memory
        by_agent = forward(self._layers, hidden.swapaxes(0, 1), self.spec)
        return self.spec.action(by_agent.swapaxes(0, 1)), memory
