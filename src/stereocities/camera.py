"""A rigorous pushbroom camera on a circular orbit, in ECEF, and the frame of a city.

World coordinates are metres in the tangent frame at the city's centre: x east, y north, z along
the ellipsoid's normal there, the origin at the city's base height. The frame is Cartesian, so that
rays are straight lines in it and the way to ECEF is one rotation.

The satellite flies a circle that is fixed in inertial space while the Earth turns below. Every
line is taken at its own time from its own position and attitude; all pixels of a line lie in one
plane of the camera. Attitude is yaw steering plus roll, pitch and yaw polynomials of time, and
jitter of roll and pitch, which RPCs cannot follow. Image coordinates are (col, row), (0, 0) the
centre of the upper-left pixel.

A camera is a flat float64 array for the kernels, made by :func:`aim`; its fields are the constants
below. Where the radius of the orbit is 0, it sees as given RPCs do, for the twin of a place that
real images show: each line has a position, and each pixel looks from there through a ground point,
both smooth functions of the image coordinates but for jitter (:func:`.rpcs.rpc_camera`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from stereotruth.core.kernels import inlined, kernel

from .cities import Jitter

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
EARTH_RATE = 7.292115e-5  # rad/s
GRAVITY = 3.986004418e14  # m³/s²

WAVES, WAVE = 37, 38  # number of the waves of jitter, and the first one's fields
ROLL_WAVE, PITCH_WAVE, PER_ROW, PHASE = 0, 1, 2, 3  # amplitudes and frequency in rad, phase
MOST_WAVES = 8
END = WAVE + 4 * MOST_WAVES

PER_COL, PER_LINE = 12, 35  # what jitter is measured by: 1, so that it is in px
MIDDLE_ROW = 36
GROUND_X, GROUND_Y = END, END + 10  # cubics of (u, v): where a pixel looks at z = 0
STATION_X, STATION_Y, STATION_Z = END + 20, END + 23, END + 26  # quadratic in v; one height
# u = (col − MIDDLE_COL) / COLS, v likewise by MIDDLE_ROW
MIDDLE_COL, COLS, ROWS = END + 27, END + 28, END + 29
INVERSE = END + 30  # (col, row) per metre of ground, row by row
RPC_SIZE = END + 34
CLOSE_PX = 1e-7

ALTITUDE_M = 505e3
INCLINATION_DEG = 97.4
LOOK_DEG = {"left": -5.0, "right": 26.0}  # along track, negative looks back

RADIUS, MOTION, P, Q = 0, 1, 2, 5  # orbit: radius, inertial rate, in-plane axes in ECEF at time 0
TIME0, PERIOD = 8, 9  # time of row 0, seconds per row
LOOK, COL0, PITCH_PER_COL = 10, 11, 12  # tangent of the look, principal column, tangent per px
ROLL, PITCH, YAW, TIME_REF = 13, 16, 19, 22  # polynomials of (time - TIME_REF), degree 2, rad
FRAME = 23  # origin and axes of the world frame
SLOPE = 35  # d(look tangent)/d(row) of a ground point, start value of the solver
ROWS_MID = 36
SIZE = END


def geodetic_to_ecef(lon: np.ndarray, lat: np.ndarray, height: np.ndarray) -> np.ndarray:
    """ECEF metres [..., 3] of WGS 84 degrees and ellipsoidal metres."""
    lam, phi = np.radians(lon), np.radians(lat)
    normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY2 * np.sin(phi) ** 2)
    return np.stack(
        [
            (normal + height) * np.cos(phi) * np.cos(lam),
            (normal + height) * np.cos(phi) * np.sin(lam),
            (normal * (1 - ECCENTRICITY2) + height) * np.sin(phi),
        ],
        axis=-1,
    )


@inlined
def ecef_to_geodetic_point(x, y, z):
    """Longitude, latitude (degrees) and ellipsoidal height (m) of one ECEF point.

    Bowring's formula, iterated: below 1e-12 degrees within 100 km of the ellipsoid.
    """
    semi_minor = SEMI_MAJOR_M * (1 - FLATTENING)
    second = ECCENTRICITY2 / (1 - ECCENTRICITY2)
    p = math.sqrt(x * x + y * y)
    tan_u = z * SEMI_MAJOR_M / (p * semi_minor)
    tan_phi = 0.0
    for _ in range(2):
        cos_u = 1 / math.sqrt(1 + tan_u * tan_u)
        sin_u = tan_u * cos_u
        tan_phi = (z + second * semi_minor * sin_u**3) / (
            p - ECCENTRICITY2 * SEMI_MAJOR_M * cos_u**3
        )
        tan_u = (1 - FLATTENING) * tan_phi
    cos_phi = 1 / math.sqrt(1 + tan_phi * tan_phi)
    sin_phi = tan_phi * cos_phi
    height = (
        p * cos_phi + z * sin_phi - SEMI_MAJOR_M * math.sqrt(1 - ECCENTRICITY2 * sin_phi * sin_phi)
    )
    return math.degrees(math.atan2(y, x)), math.degrees(math.atan(tan_phi)), height


@kernel
def _ecef_to_geodetic(xyz, out):
    for i in range(xyz.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = ecef_to_geodetic_point(xyz[i, 0], xyz[i, 1], xyz[i, 2])


def ecef_to_geodetic(xyz: np.ndarray) -> np.ndarray:
    """WGS 84 longitude, latitude (degrees), ellipsoidal height (m), [n, 3], of ECEF [n, 3]."""
    xyz = np.ascontiguousarray(np.atleast_2d(xyz), dtype=np.float64)
    out = np.empty_like(xyz)
    _ecef_to_geodetic(xyz, out)
    return out


@dataclass(frozen=True)
class LocalFrame:
    """The city's tangent frame: centre in degrees, ellipsoidal height of z = 0 in metres."""

    lon: float
    lat: float
    height: float

    @property
    def origin(self) -> np.ndarray:
        """ECEF position [3] of the frame's origin."""
        return geodetic_to_ecef(*(np.float64(v) for v in (self.lon, self.lat, self.height)))

    @property
    def axes(self) -> np.ndarray:
        """ECEF unit vectors [3, 3], rows east, north, up."""
        lam, phi = math.radians(self.lon), math.radians(self.lat)
        sl, cl, sp, cp = math.sin(lam), math.cos(lam), math.sin(phi), math.cos(phi)
        return np.array([[-sl, cl, 0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])

    def to_ecef(self, xyz: np.ndarray) -> np.ndarray:
        """ECEF [n, 3] of world points [n, 3]."""
        return self.origin + np.atleast_2d(xyz) @ self.axes

    def to_geodetic(self, xyz: np.ndarray) -> np.ndarray:
        """Longitude, latitude, ellipsoidal height [n, 3] of world points [n, 3]."""
        return ecef_to_geodetic(self.to_ecef(xyz))

    def from_geodetic(self, lonlath: np.ndarray) -> np.ndarray:
        """World points [n, 3] of longitude, latitude, ellipsoidal height [n, 3]."""
        ecef = geodetic_to_ecef(*np.atleast_2d(lonlath).T)
        return (ecef - self.origin) @ self.axes.T

    def packed(self) -> np.ndarray:
        """float64[12] for kernels: origin, then the axes row by row."""
        return np.concatenate([self.origin, self.axes.ravel()])


@inlined
def world_to_geodetic_point(frame, x, y, z):
    """Longitude, latitude (degrees), ellipsoidal height (m) of one world point."""
    return ecef_to_geodetic_point(
        frame[0] + frame[3] * x + frame[6] * y + frame[9] * z,
        frame[1] + frame[4] * x + frame[7] * y + frame[10] * z,
        frame[2] + frame[5] * x + frame[8] * y + frame[11] * z,
    )


@inlined
def swings(cam, row):
    """What all waves together add to roll and pitch at a line."""
    roll = pitch = 0.0
    for k in range(int(cam[WAVES])):
        at = WAVE + 4 * k
        swing = math.sin(cam[at + PHASE] + cam[at + PER_ROW] * row)
        roll += cam[at + ROLL_WAVE] * swing
        pitch += cam[at + PITCH_WAVE] * swing
    return roll, pitch


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
    v = (row - cam[MIDDLE_ROW]) / cam[ROWS]
    out[0] = cam[STATION_X] + v * (cam[STATION_X + 1] + v * cam[STATION_X + 2])
    out[1] = cam[STATION_Y] + v * (cam[STATION_Y + 1] + v * cam[STATION_Y + 2])
    out[2] = cam[STATION_Z]
    out[3] = v
    swing_col, swing_row = swings(cam, row)
    out[4], out[5] = swing_col / cam[COLS], swing_row / cam[ROWS]


@inlined
def direction_by_rpc(cam, line, col):
    """Direction (not normalised, z < 0) of the ray of a column, given its line's pose."""
    u, v = (col - cam[MIDDLE_COL]) / cam[COLS] + line[4], line[3] + line[5]
    x, y = _cubic(cam, GROUND_X, u, v), _cubic(cam, GROUND_Y, u, v)
    return x - line[0], y - line[1], -line[2]


@inlined
def project_by_rpc(cam, x, y, z, line):
    """(col, row) of a world point; ``line`` gets the pose of the row."""
    col, row = cam[MIDDLE_COL], cam[MIDDLE_ROW]
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


@inlined
def pose(cam, row, out):
    """Write position and body axes (forward, left, up) of one line, world frame, to out[12].

    Of a camera by given RPCs: its position, and what its directions follow from.
    """
    if cam[RADIUS] == 0.0:
        pose_by_rpc(cam, row, out)
        return
    t = cam[TIME0] + row * cam[PERIOD]
    # the circle in inertial space, turned back into ECEF
    c, s = math.cos(cam[MOTION] * t), math.sin(cam[MOTION] * t)
    ce, se = math.cos(EARTH_RATE * t), math.sin(EARTH_RATE * t)
    ux, uy, uz = (
        c * cam[P] + s * cam[Q],
        c * cam[P + 1] + s * cam[Q + 1],
        c * cam[P + 2] + s * cam[Q + 2],
    )
    fx, fy, fz = (
        c * cam[Q] - s * cam[P],
        c * cam[Q + 1] - s * cam[P + 1],
        c * cam[Q + 2] - s * cam[P + 2],
    )
    ux, uy = ce * ux + se * uy, -se * ux + ce * uy
    fx, fy = ce * fx + se * fy, -se * fx + ce * fy
    lx, ly, lz = uy * fz - uz * fy, uz * fx - ux * fz, ux * fy - uy * fx
    d = t - cam[TIME_REF]
    roll = cam[ROLL] + d * (cam[ROLL + 1] + d * cam[ROLL + 2])
    pitch = cam[PITCH] + d * (cam[PITCH + 1] + d * cam[PITCH + 2])
    yaw = cam[YAW] + d * (cam[YAW + 1] + d * cam[YAW + 2])
    swing_roll, swing_pitch = swings(cam, row)
    roll += swing_roll
    pitch += swing_pitch
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    # body axes in (forward, left, up): Rz(yaw) Ry(pitch) Rx(roll)
    m00, m01, m02 = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    m10, m11, m12 = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    m20, m21, m22 = -sp, cp * sr, cp * cr
    for k in range(3):
        ax, ay, az = cam[FRAME + 3 + 3 * k], cam[FRAME + 4 + 3 * k], cam[FRAME + 5 + 3 * k]
        f = ax * fx + ay * fy + az * fz
        le = ax * lx + ay * ly + az * lz
        u = ax * ux + ay * uy + az * uz
        out[k] = cam[RADIUS] * u - (ax * cam[FRAME] + ay * cam[FRAME + 1] + az * cam[FRAME + 2])
        out[3 + k] = f * m00 + le * m10 + u * m20
        out[6 + k] = f * m01 + le * m11 + u * m21
        out[9 + k] = f * m02 + le * m12 + u * m22


@inlined
def direction(cam, line, col):
    """Direction (not normalised, z < 0) of the ray of a column, given its line's pose."""
    if cam[RADIUS] == 0.0:
        return direction_by_rpc(cam, line, col)
    across = (col - cam[COL0]) * cam[PITCH_PER_COL]
    look = cam[LOOK]
    return (
        look * line[3] + across * line[6] - line[9],
        look * line[4] + across * line[7] - line[10],
        look * line[5] + across * line[8] - line[11],
    )


@inlined
def project_point(cam, x, y, z, row, line):
    """(col, row) of a world point; ``row`` is a first guess, ``line`` float64[12] is scratch.

    Solves for the line time by the secant method; the pose in ``line`` is that of the result to
    1e-4 rows, 0.1 mm of the satellite's way.
    """
    if cam[RADIUS] == 0.0:
        return project_by_rpc(cam, x, y, z, line)
    slope = cam[SLOPE]
    last = 0.0
    step = 0.0
    across = 0.0
    for k in range(20):
        pose(cam, row, line)
        vx, vy, vz = x - line[0], y - line[1], z - line[2]
        depth = -(vx * line[9] + vy * line[10] + vz * line[11])
        miss = (vx * line[3] + vy * line[4] + vz * line[5]) / depth - cam[LOOK]
        across = (vx * line[6] + vy * line[7] + vz * line[8]) / depth
        if k > 0 and step != 0.0:
            slope = (miss - last) / step
        last = miss
        step = -miss / slope
        row += step
        if abs(step) < 1e-4:  # the slope is known to 1e-3: what is left is below 1e-7 rows
            break
    return cam[COL0] + across / cam[PITCH_PER_COL], row


@kernel
def _project(cam, xyz, out):
    line = np.empty(12)
    row = cam[ROWS_MID]
    for i in range(xyz.shape[0]):
        out[i, 0], row = project_point(cam, xyz[i, 0], xyz[i, 1], xyz[i, 2], row, line)
        out[i, 1] = row


def project(cam: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """Image coordinates [n, 2] (col, row) of world points [n, 3]."""
    xyz = np.ascontiguousarray(np.atleast_2d(xyz), dtype=np.float64)
    out = np.empty((len(xyz), 2))
    _project(cam, xyz, out)
    return out


@kernel
def _rays(cam, colrow, origin, toward):
    line = np.empty(12)
    for i in range(colrow.shape[0]):
        pose(cam, colrow[i, 1], line)
        dx, dy, dz = direction(cam, line, colrow[i, 0])
        origin[i, 0], origin[i, 1], origin[i, 2] = line[0], line[1], line[2]
        toward[i, 0], toward[i, 1], toward[i, 2] = dx / dz, dy / dz, 1.0


def rays(cam: np.ndarray, colrow: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays of image points [n, 2]: positions [n, 3] and directions [n, 3] scaled to dz = 1."""
    colrow = np.ascontiguousarray(np.atleast_2d(colrow), dtype=np.float64)
    origin, toward = np.empty((len(colrow), 3)), np.empty((len(colrow), 3))
    _rays(cam, colrow, origin, toward)
    return origin, toward


def locate(
    cam: np.ndarray, frame: LocalFrame, colrow: np.ndarray, height: np.ndarray
) -> np.ndarray:
    """World points [n, 3] on the rays of image points [n, 2] at ellipsoidal heights [n]."""
    origin, toward = rays(cam, colrow)
    z = np.asarray(height, dtype=np.float64) - frame.height
    for _ in range(6):  # height and z differ by the Earth's curvature only
        xyz = origin + (z - origin[:, 2])[:, None] * toward
        z = z + (height - frame.to_geodetic(xyz)[:, 2])
    return origin + (z - origin[:, 2])[:, None] * toward


@dataclass(frozen=True, eq=False)
class Pass:
    """How a satellite flies over the target and looks at it.

    ``look_deg`` along the track, negative looks back; ``aside_m``: distance of the target from the
    ground track; ``yaw_rad`` beside yaw steering; ``drift`` float64[3, 2]: rate and bend of roll,
    pitch and yaw, rad/s and rad/s².
    """

    look_deg: float
    aside_m: float
    ascending: bool
    yaw_rad: float = 0.0
    drift: np.ndarray = field(default_factory=lambda: np.zeros((3, 2)))

    @classmethod
    def drawn(cls, view: str, seed: int, *, ascending: bool) -> Pass:
        """Of one view of a pair, ``"left"`` or ``"right"``, both taken on one pass of a ``seed``.

        Drawn are the target's distance from the track (±30 km), a yaw of up to 0.7 degrees, and
        the drift of the attitude; the track is the same for both views.
        """
        track = np.random.default_rng([seed, 1])
        own = np.random.default_rng([seed, 2 if view == "left" else 3])
        aside = track.uniform(-30e3, 30e3)
        yaw = math.radians(track.uniform(-0.4, 0.4) + own.uniform(-0.3, 0.3))
        return cls(LOOK_DEG[view], aside, ascending, yaw, drift_of_attitude(own))


def drift_of_attitude(rng: np.random.Generator) -> np.ndarray:
    """Rate and bend of roll, pitch and yaw [3, 2], see :class:`Pass`."""
    return rng.normal(size=(3, 2)) * [[2e-5, 1.5e-5], [2e-5, 1.5e-5], [4e-5, 3e-5]]


def jittering(cam: np.ndarray, jitter: Jitter, rng: np.random.Generator) -> np.ndarray:
    """The camera with roll and pitch that swing along the lines, phases drawn apart.

    Each of both moves the image by ``jitter.rms_px`` px rms, in equal parts by all its waves.
    """
    if 2 * len(jitter.periods) > MOST_WAVES:
        raise ValueError(f"a camera jitters by {MOST_WAVES // 2} waves at most")
    cam = cam.copy()
    rows = 2.0 * cam[ROWS_MID] + 1.0
    amplitude = jitter.rms_px * math.sqrt(2.0 / len(jitter.periods))
    for axis, radians_per_px in ((ROLL_WAVE, cam[PITCH_PER_COL]), (PITCH_WAVE, abs(cam[SLOPE]))):
        for periods in jitter.periods:
            at = WAVE + 4 * int(cam[WAVES])
            cam[at + axis] = amplitude * radians_per_px
            cam[at + PER_ROW] = 2.0 * math.pi * periods / rows
            cam[at + PHASE] = rng.uniform(0.0, 2.0 * math.pi)
            cam[WAVES] += 1.0
    return cam


def aim(
    frame: LocalFrame, target: np.ndarray, flown: Pass, *, gsd: float, cols: int, rows: int
) -> np.ndarray:
    """A camera whose image centre shows the world point ``target`` [3].

    ``gsd``: metres per px at the target, across (at right angles to the ray) and along track.
    """
    cam = np.zeros(SIZE)
    cam[FRAME : FRAME + 12] = frame.packed()
    ground = frame.to_ecef(target)[0]
    up = ground / np.linalg.norm(ground)
    cam[RADIUS] = np.linalg.norm(ground) + ALTITUDE_M
    cam[MOTION] = math.sqrt(GRAVITY / cam[RADIUS] ** 3)
    # inertial heading from the inclination; P lies above the target, aside by the track's offset
    latitude = math.asin(up[2])
    azimuth = math.asin(math.cos(math.radians(INCLINATION_DEG)) / math.cos(latitude))
    if not flown.ascending:
        azimuth = math.pi - azimuth
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    forward = math.sin(azimuth) * east + math.cos(azimuth) * north
    aside = flown.aside_m / cam[RADIUS]
    cam[P : P + 3] = math.cos(aside) * up + math.sin(aside) * np.cross(up, forward)
    cam[Q : Q + 3] = forward
    cam[LOOK] = math.tan(math.radians(flown.look_deg))
    cam[COL0] = (cols - 1) / 2
    cam[ROWS_MID] = (rows - 1) / 2
    cam[YAW] = flown.yaw_rad
    for axis, (rate, bend) in zip((ROLL, PITCH, YAW), flown.drift):
        cam[axis + 1], cam[axis + 2] = rate, bend
    cam[TIME_REF] = cam[TIME0] = -cam[LOOK] * ALTITUDE_M / 7000.0
    line = np.empty(12)

    def angles(time: float) -> tuple[float, float, float]:
        """Look and across tangents of the target at a time, and its depth."""
        cam[TIME_REF] = cam[TIME0] = time
        pose(cam, 0.0, line)
        offset = np.asarray(target, dtype=np.float64) - line[:3]
        depth = -offset @ line[9:]
        return offset @ line[3:6] / depth, offset @ line[6:9] / depth, depth

    def footprint_velocity(time: float) -> np.ndarray:
        """How the footprint runs over the turning Earth, world frame, m/s."""
        level = cam.copy()
        level[ROLL:TIME_REF] = 0.0
        level[TIME0] = time
        pose(level, 0.0, line)
        turning = frame.axes @ np.cross([0.0, 0.0, EARTH_RATE], ground)
        return cam[MOTION] * np.linalg.norm(ground) * line[3:6] - turning

    skew = cam[YAW]
    time = cam[TIME0]
    for _ in range(30):
        velocity = footprint_velocity(time)
        # yaw steering: lines stay across the track although the Earth turns
        cam[YAW] = skew + math.atan2(velocity @ line[6:9], velocity @ line[3:6])
        rate = (angles(time + 0.05)[0] - angles(time - 0.05)[0]) / 0.1
        look, across, _depth = angles(time)
        time -= (look - cam[LOOK]) / rate
        cam[ROLL] += math.atan(across)
        if abs(look - cam[LOOK]) < 1e-12 and abs(across) < 1e-12:
            break
    depth = angles(time)[2]
    cam[PITCH_PER_COL] = gsd / depth
    cam[PERIOD] = gsd / np.linalg.norm(footprint_velocity(time))
    cam[TIME0] = time - cam[PERIOD] * cam[ROWS_MID]
    cam[TIME_REF] = time
    looks = []
    for row in (cam[ROWS_MID] - 50, cam[ROWS_MID] + 50):
        pose(cam, row, line)
        offset = np.asarray(target, dtype=np.float64) - line[:3]
        looks.append(offset @ line[3:6] / -(offset @ line[9:]))
    cam[SLOPE] = (looks[1] - looks[0]) / 100
    return cam
