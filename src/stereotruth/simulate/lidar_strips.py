"""Strips of a LiDAR flight as real ones are: they overlap, and none lies quite where it should.

A strip has an offset in plan and in height, perhaps a roll, and pulses of a density of its own. Its
points tell it as those of real files do: by ``point_source_id``, by times that leave gaps between
the strips, and by the flag of the first and last point of each line of pulses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import laspy
import numpy as np

from .cities import CitySpec, FlightStrip, SceneSpec
from .lidar_coverage import coverage

OVERLAP = 0.3  # of a strip's width, shared with the next one
SPEED_M_S = 60.0
START_S = 275_400_000.0  # adjusted GPS time of the first strip, in 2020
TURN_S = 240.0  # from the end of a strip to the beginning of the next one
EDGE_OF_LINE = np.uint8(0x80)
EDGE_PULSES = 3.0  # from a strip's end: lines that end earlier leave its ground, not the strip


@dataclass(frozen=True)
class FlownStrip:
    """A strip over a scene: its ``number`` from 1 on, and its ``west`` and ``east`` end, m.

    ``south``, ``north``: where its line begins and ends.
    """

    strip: FlightStrip
    number: int
    west: float
    east: float
    south: float
    north: float

    @property
    def spacing_m(self) -> float:
        """Of its pulses."""
        return self.strip.spacing_m

    def taken(self, xyz: np.ndarray, info: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Those of points [n, 3] that it measures, where it has them, and their ``info`` [n, 6]."""
        inside = (xyz[:, 0] >= self.west) & (xyz[:, 0] < self.east)
        xyz, info = xyz[inside], info[inside]
        across = xyz[:, 0] - (self.west + self.east) / 2
        xyz = xyz + self.strip.offset_m
        xyz[:, 2] -= across * math.tan(math.radians(self.strip.roll_deg))
        info[:, 5] = self.number
        return xyz, info

    def tell(self, fields: np.ndarray, header: laspy.LasHeader, xyz: np.ndarray) -> None:
        """Fill the fields of points at ``xyz`` [n, 3] that tell when and where in a line they were
        measured; lines of pulses lie one behind the other in their order."""
        if "gps_time" in fields.dtype.names:
            start = START_S + self.number * ((self.north - self.south) / SPEED_M_S + TURN_S)
            fields["gps_time"] = start + (xyz[:, 1] - self.south) / SPEED_M_S
        new = np.diff(xyz[:, 1]) > self.spacing_m / 2
        across, near = xyz[:, 0] - self.strip.offset_m[0], EDGE_PULSES * self.spacing_m
        edge = np.append(new, True) & (across > self.east - near)
        edge |= np.append(True, new) & (across < self.west + near)
        flags = "classification_flags" if header.point_format.id >= 6 else "bit_fields"
        fields[flags] |= edge * EDGE_OF_LINE


def flown_strips(city: CitySpec, scene: SceneSpec) -> list[FlownStrip]:
    """The strips of a city over a scene, each beside the one before; none if it has none."""
    if not city.strips:
        return []
    c = coverage(city, scene)
    corners = np.array([
        c[:2] + a * c[2:4] + b * c[4:6]
        for a in (-c[6] - c[8], c[6])
        for b in (-c[7], c[7] + c[8])
    ])  # fmt: skip
    low, high = corners.min(axis=0), corners.max(axis=0)
    step = (high[0] - low[0]) / (len(city.strips) - OVERLAP * (len(city.strips) - 1))
    return [
        FlownStrip(
            strip,
            number,
            low[0] + (number - 1) * step * (1 - OVERLAP),
            low[0] + (number - 1) * step * (1 - OVERLAP) + step,
            low[1],
            high[1],
        )
        for number, strip in enumerate(city.strips, 1)
    ]
