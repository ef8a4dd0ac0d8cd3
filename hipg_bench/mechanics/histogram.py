"""How many things stand around an agent, by ring and sector: a view of fixed size for any team.

Four rings out to 1 m, their edges evenly spaced in log distance, and eight sectors of 45 degrees
centred on 0, 45, ... degrees from the x axis. Source: the authors' histogram observation (facts
sheet, section 1).
"""

from __future__ import annotations

import numpy as np

RINGS, SECTORS = 4, 8
EDGES = np.logspace(-1, 0, RINGS)
"""Outer edges of the rings, m: 0.1, 0.2154, 0.4642, 1. A thing on an edge is inside."""
