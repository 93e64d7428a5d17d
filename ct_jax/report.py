"""The report of a run: one self-contained HTML page, and the gist of it as one PNG page.

``read_run`` takes whatever a run folder holds, finished or not; each part of the page is one function from that to
HTML, and says in a line what it misses. The page needs no script and nothing from outside: pictures are inline SVG
whose colours follow light and dark mode. All text that comes from files is escaped.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from html import escape
from importlib import resources
from itertools import product, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from ct_envs.errors import UserError
from ct_envs.maze import parse_walls

from ct_jax import __version__
from ct_jax.overview import Overview, draw_overview
from ct_jax.pictures import (
    DARK,
    LEVELS,
    LIGHT,
    draw_calibration,
    draw_curve,
    draw_maze,
    draw_paths,
    draw_roadmap,
    maze_figure,
    plot_figure,
    to_svg,
    track,
)

__all__ = ["draw_maze", "draw_paths", "read_run", "write_report"]
