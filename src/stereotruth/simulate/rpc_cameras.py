"""Cameras that see as given RPCs do, for the twin of a place that real images show.

Such a camera is what a pushbroom sensor is over one scene: each line has a position, and each pixel
looks from there through a ground point, both smooth functions of the image coordinates but for
jitter. Its array has the fields below, in the place of those of :mod:`.camera`, whose first, the
radius of the orbit, is 0. :func:`.given_rpcs.rpc_camera` makes it.
"""

from __future__ import annotations

from ..kernels import inlined
from .jitter_waves import END, swings

PER_COL, PER_LINE = 12, 35  # what jitter is measured by: 1, so that it is in px
ROW0 = 36
GROUND_X, GROUND_Y = END, END + 10  # cubics of (u, v): where a pixel looks at z = 0
STATION_X, STATION_Y, STATION_Z = END + 20, END + 23, END + 26  # quadratic in v; one height
COL0, COLS, ROWS = END + 27, END + 28, END + 29  # u = (col − COL0) / COLS, v likewise by ROW0
INVERSE = END + 30  # (col, row) per metre of ground, row by row
SIZE = END + 34
CLOSE_PX = 1e-7


@inlined
def _cubic(cam, at, u, v):
    c = cam[at] + cam[at + 1] * u + cam[at + 2] * v
    c += cam[at + 3] * u * u + cam[at + 4] * u * v + cam[at + 5] * v * v
    c += cam[at + 6] * u * u * u + cam[at + 7] * u * u * v
    return c + cam[at + 8] * u * v * v + cam[at + 9] * v * v * v


@inlined
def pose_by_rpc(cam, row, out):
    """Write the position of a line to out[:3], its v to out[3], and to out[4:6] what jitter adds to
    u and v there."""
    v = (row - cam[ROW0]) / cam[ROWS]
    out[0] = cam[STATION_X] + v * (cam[STATION_X + 1] + v * cam[STATION_X + 2])
    out[1] = cam[STATION_Y] + v * (cam[STATION_Y + 1] + v * cam[STATION_Y + 2])
    out[2] = cam[STATION_Z]
    out[3] = v
    swing_col, swing_row = swings(cam, row)
    out[4], out[5] = swing_col / cam[COLS], swing_row / cam[ROWS]


@inlined
def direction_by_rpc(cam, line, col):
    """Direction (not normalised, z < 0) of the ray of a column, given its line's pose."""
    u, v = (col - cam[COL0]) / cam[COLS] + line[4], line[3] + line[5]
    x, y = _cubic(cam, GROUND_X, u, v), _cubic(cam, GROUND_Y, u, v)
    return x - line[0], y - line[1], -line[2]


@inlined
def project_by_rpc(cam, x, y, z, line):
    """(col, row) of a world point; ``line`` gets the pose of the row."""
    col, row = cam[COL0], cam[ROW0]
    for _ in range(40):
        pose_by_rpc(cam, row, line)
        dx, dy, dz = direction_by_rpc(cam, line, col)
        miss_x = x - line[0] - dx / dz * (z - line[2])
        miss_y = y - line[1] - dy / dz * (z - line[2])
        step_col = cam[INVERSE] * miss_x + cam[INVERSE + 1] * miss_y
        step_row = cam[INVERSE + 2] * miss_x + cam[INVERSE + 3] * miss_y
        col += step_col
        row += step_row
        if abs(step_col) < CLOSE_PX and abs(step_row) < CLOSE_PX:
            break
    return col, row
