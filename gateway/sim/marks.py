"""What cameras look for in a scene, AprilTags and coloured balls, as MJCF: drawn, and met by nothing."""

from __future__ import annotations

import math
from itertools import groupby

from gateway.sim.files import Ball, Tag
from gateway.vision.tags import CELLS, pattern

SEEN = 'group="2" contype="0" conaffinity="0"'
"""Attributes of a geom that is drawn, and that neither beams nor robots meet."""
THICK, RAISED = 0.002, 0.0005
"""m, of a tag's white plate, and of its black cells above that."""


def tag_xml(tag: Tag) -> str:
    """Return a tag: a white plate, and its black cells, neighbours in a row as one."""
    cell = tag.size / CELLS
    margin = tag.size / 2.0 + cell
    plate = f'size="{THICK / 2.0} {margin} {margin}" pos="{-THICK / 2.0} 0 0"'
    parts = [f'<geom type="box" {plate} rgba="1 1 1 1" {SEEN}/>']
    for row, blacks in enumerate(pattern(tag.marker)):
        column = 0
        for black, run in groupby(blacks):
            count = len(list(run))
            if black:
                # Columns grow to the right of who looks at it: along its own y; rows downward.
                y = (column + count / 2.0 - CELLS / 2.0) * cell
                z = (CELLS / 2.0 - row - 0.5) * cell
                size = f"{RAISED / 2.0} {count * cell / 2.0} {cell / 2.0}"
                parts.append(
                    f'<geom type="box" size="{size}" pos="{RAISED / 2.0} {y} {z}" rgba="0 0 0 1" {SEEN}/>'
                )
            column += count
    turned = f"{math.cos(tag.yaw / 2.0)} 0 0 {math.sin(tag.yaw / 2.0)}"
    return f'<body pos="{tag.x} {tag.y} {tag.z}" quat="{turned}">{"".join(parts)}</body>'


def ball_xml(ball: Ball) -> str:
    """Return a ball."""
    colour = " ".join(map(str, ball.colour))
    at = f"{ball.x} {ball.y} {ball.z}"
    return f'<geom type="sphere" size="{ball.diameter / 2.0}" pos="{at}" rgba="{colour} 1" {SEEN}/>'
