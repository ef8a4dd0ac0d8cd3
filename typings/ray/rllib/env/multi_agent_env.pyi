from typing import Any

import numpy as np
from gymnasium import Space

class MultiAgentEnv:
    agents: list[str]
    possible_agents: list[str]
    observation_spaces: dict[str, Space[Any]] | None
    action_spaces: dict[str, Space[Any]] | None
    metadata: dict[str, Any]
    render_mode: str | None
    def __init__(self) -> None: ...
    @property
    def np_random(self) -> np.random.Generator: ...
